"""What a daemon counts, keeps for the next start, reports, and tells the service manager."""

import asyncio
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.recording.writing.disk import DiskProcess
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.running.opening.open_stand import OpenStand
from thermostand.stand.service import systemd
from thermostand.stand.service.counters import Counters, CountersFile, StoredCounters, load_counters
from thermostand.stand.service.daemon import ReportQueue
from thermostand.stand.service.run_queue import RunQueue
from thermostand.stand.serving.api_models import Conflict, Requester, RunRequest


def read(hub: Hub, time_s: float, **values: float) -> None:
    """One batch of a device: `relays_compressor=1` is its channel and value."""
    time_ns = round(time_s * NS_PER_S)
    readings = tuple(Reading(name.replace("__", "."), value, "1", time_ns) for name, value in values.items())
    hub.publish(Batch(readings[0].channel.partition(".")[0], time_ns, readings))


def test_what_wears_is_counted_from_what_is_read():
    hub = Hub()
    counters = Counters({"compressor_starts": 7.0}, ["linear"], 2000.0, hub)
    for time_s, on in ((0, 0), (10, 1), (20, 1), (30, 1), (40, 0)):
        read(hub, time_s, relays__compressor=on, relays__heater_enable=on)
        read(hub, time_s, regulator__mv_heat=50.0)
    for time_s, position in ((0, 0.0), (5, 0.4), (10, 1.0), (15, 1.0), (20, 0.0), (25, 1.0)):
        read(hub, time_s, flap__position=position)
    for time_s, position, moving in ((0, 0.0, 0), (5, 1.0, 1), (10, 2.0, 1), (15, 2.0, 0), (20, 2.0, 0), (25, 0.0, 0)):
        read(hub, time_s, linear__position=position, linear__moving=moving)
    values = counters.values
    assert values["compressor_starts"] == 8
    assert values["compressor_hours"] == pytest.approx(30 / 3600)
    assert values["relay_cycles.compressor"] == values["relay_cycles.heater_enable"] == 1
    assert values["flap_cycles"] == 2
    assert values["stage_cycles.linear"] == 2  # the second lay between two polls
    assert values["heater_Wh"] == pytest.approx(0.5 * 2000 * 30 / 3600)


def test_what_was_not_read_is_not_counted():
    hub = Hub()
    counters = Counters({}, [], 2000.0, hub)
    read(hub, 0, relays__compressor=1)
    hub.publish(Batch("relays", NS_PER_S, (bad_reading("relays.compressor", "1", NS_PER_S, "no answer", "wire"),)))
    read(hub, 3600, relays__compressor=1)  # an hour in which nobody knows
    assert counters.values["compressor_hours"] == 0
    assert counters.values["compressor_starts"] == 0


async def test_counters_are_kept_for_the_next_daemon(tmp_path: Path):
    kept = CountersFile(tmp_path, lambda function, *arguments: function(*arguments), Hub(), WallClock())
    last = StoredCounters(counters={"flap_cycles": 3.0})
    kept.note(StoredCounters(counters={"flap_cycles": 1.0}))
    kept.note(last)
    await kept.close(ShutdownDeadline())
    assert load_counters(tmp_path) == (last, "")
    (tmp_path / "daemon.json").write_text("{")
    found, damage = load_counters(tmp_path)  # a damaged file is no reason not to open a stand
    assert (found, "begin again at 0" in damage) == (StoredCounters(), True)
    assert (tmp_path / "daemon.json.damaged").read_text() == "{"
    assert load_counters(tmp_path / "nowhere") == (StoredCounters(), "")


async def test_a_disk_that_refuses_is_an_event(tmp_path: Path):
    def refused(*_: object) -> None:
        raise OSError(28, "No space left on device")

    hub, events = Hub(), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    kept = CountersFile(tmp_path, refused, hub, WallClock())
    kept.note(StoredCounters())
    await kept.close(ShutdownDeadline())
    assert [event.kind for event in events] == ["daemon_not_kept"]


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """The service manager's socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as found:
        found.bind(str(tmp_path / "notify"))
        found.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield found


def test_the_service_manager_is_notified_in_lines(manager: socket.socket, monkeypatch: pytest.MonkeyPatch):
    systemd.notify_systemd(systemd.READY, "STATUS=idle")
    assert manager.recv(1000) == b"READY=1\nSTATUS=idle"
    systemd.notify_systemd(systemd.make_extension(60.0))
    assert manager.recv(1000) == b"EXTEND_TIMEOUT_USEC=60000000"
    monkeypatch.setenv("WATCHDOG_USEC", "30000000")
    assert systemd.watchdog_s() == 30.0
    monkeypatch.setenv("WATCHDOG_PID", "1")  # somebody else's
    assert systemd.watchdog_s() is None


def test_what_is_done_is_reported_to_the_service_manager_when_it_changes(manager: socket.socket):
    status = systemd.StatusNotice()
    for text in ("idle", "idle", "heat by hand", "idle"):
        status.tell(text)
    assert [manager.recv(1000) for _ in range(3)] == [b"STATUS=idle", b"STATUS=heat by hand", b"STATUS=idle"]
    with pytest.raises(BlockingIOError):
        manager.recv(1000)


def test_without_a_service_manager_nobody_is_notified(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    monkeypatch.delenv("WATCHDOG_USEC", raising=False)
    systemd.notify_systemd(systemd.READY)
    assert systemd.watchdog_s() is None


async def test_a_run_whose_report_fails_is_an_event_and_the_next_has_its_turn(tmp_path: Path):
    hub, reported = Hub(), list[str]()
    hub.subscribe(lambda item: reported.append(f"{item.kind}: {item.text}") if isinstance(item, Event) else None)
    reports = ReportQueue(hub, WallClock())
    reports.add(tmp_path / "first")
    reports.add(tmp_path / "second")
    async with asyncio.timeout(300):  # a report is made when nothing else wants the processor
        while not reported:
            await asyncio.sleep(0.05)
    await reports.close()  # the second one is given up
    (line,) = reported
    assert line.startswith(f"not_reported: {tmp_path / 'first'} is ")
    assert f"`compensate report {tmp_path / 'first'} -o report.html` tries again" in line


async def test_a_run_is_queued_only_when_what_it_needs_answers(tmp_path: Path):
    config, clock, disk = load_config(find_packaged("", "simulated")), WallClock(), DiskProcess()
    texts = {
        "config.yaml": find_packaged("", "simulated").read_text(),
        "target.yaml": find_packaged("targets", config.target).read_text(),
    }
    hub = Hub()
    open_stand = OpenStand(assemble(config, hub, clock), disk, ShutdownDeadline(), is_for_one=False)
    orders, who = RunQueue(open_stand, disk, tmp_path, "simulated", texts), Requester(name="rose", how="token")
    now_ns, request = clock.now_ns(), RunRequest(recipe="warm-up")
    hub.publish(Batch("x", now_ns, (bad_reading("thermometers.air", "degC", now_ns, "no answer", "wire"),)))
    with pytest.raises(Conflict, match=r"thermometers\.air is not read"):
        await orders.submit(who, request, "")
    hub.publish(Batch("x", now_ns, (Reading("thermometers.air", 24.0, "degC", now_ns),)))
    assert (await orders.submit(who, request, "")).id == 1
    disk.close()
