"""Heat that an operator orders between runs: it goes on over midnight, and is reported while the regulator is not
read."""

import socket
from contextlib import suppress
from pathlib import Path

import pytest

from tests.system.daemon_here import DaemonHere, served_here, until
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import bad_reading
from thermostand.recording.reading.session import Session
from thermostand.stand.service.idle_log import IdleLog
from thermostand.stand.service.stand_service import DeviceRequest
from thermostand.stand.serving.api_models import Requester


async def test_midnight_changes_the_record_beneath_heat_by_hand(
    laboratory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out, who = tmp_path / "out", Requester(name="a test", how="terminal")
    day = ["20261122"]
    monkeypatch.setattr(IdleLog, "_get_today", lambda _: day[0])
    reported: list[Event] = []
    sent: list[bytes] = []  # to the service manager
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    manager.bind(str(tmp_path / "notify"))
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))

    def is_sent(line: bytes) -> bool:
        with suppress(BlockingIOError):
            while True:
                sent.extend(manager.recv(1000).splitlines())
        return sent[-1:] == [line]

    async def work(here: DaemonHere) -> None:
        desk, hub, clock, daemon = here.desk, here.hub, here.clock, here.daemon
        hub.subscribe(lambda item: reported.append(item) if isinstance(item, Event) else None)
        await desk.device(who, DeviceRequest(device="regulator", verb="set", arguments={"setpoint_degC": 40.0}))
        await until(lambda: desk.state().heater_permitted)
        day[0] = "20261123"
        await until(lambda: daemon.record.is_of_today())
        turned_ns = clock.now_ns()
        await until(lambda: clock.now_ns() > turned_ns + 3_000_000_000)  # the guard looks each second
        assert desk.state().heater_permitted
        assert desk.state().fault is None
        by_hand, now_ns = desk.state().by_hand, clock.now_ns()
        hub.publish(Batch("regulator", now_ns, (bad_reading("regulator.running", "1", now_ns, "no answer"),)))
        assert (desk.state().setpoint_degC, desk.state().by_hand) == (None, by_hand)  # its wire is gone
        await until(lambda: desk.state().setpoint_degC == 40.0)
        assert desk.state().by_hand == by_hand is not None
        assert daemon.open_stand.recorder is daemon.record.recorder
        await until(lambda: is_sent(b"STATUS=heat by hand, set-point 40 degC"))
        desk.stop(who)
        await until(lambda: is_sent(b"STATUS=idle"))

    with manager:
        await served_here(laboratory, out, work)
    # On a busy machine a poll may take longer than its period.
    assert {event.kind for event in reported if event.level != "info"} <= {"device_slow"}
    first, second = (
        Session.open(out / f"{name}-idle-log").readings("regulator.pv")[0] for name in ("20261122", "20261123")
    )
    assert len(first) > 0
    assert len(second) > 0
    assert 0 < (second[0] - first[-1]) / 1e9 < 2.0  # of a poll each half second none is missing
