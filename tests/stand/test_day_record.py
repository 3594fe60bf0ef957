"""The daemon's own record: a session a day, and nothing lost or recorded twice when the day ends."""

import asyncio
from collections.abc import AsyncGenerator
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import RUN_END
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Reading
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.recording.reading.notes import NOTES_NAME, add_tags
from thermostand.recording.reading.run_status import Files
from thermostand.recording.reading.scan import verify
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.assemble import Assembly
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.service.idle_log import IdleLog, remove_idle_logs

CONFIG = find_packaged("", "simulated")


class Calendar(WallClock):
    """The host's clock, `ahead_ns` ahead."""

    ahead_ns = 0

    def now_ns(self) -> int:
        return super().now_ns() + self.ahead_ns

    def go_to_midnight(self, before_s: float) -> None:
        """So long before the next midnight of this place."""
        now = datetime.fromtimestamp((self.now_ns() + self.utc_offset_ns()) / NS_PER_S).astimezone()
        midnight = (now + timedelta(days=1)).replace(hour=0, minute=0, second=0, microsecond=0)
        self.ahead_ns += round(((midnight - now).total_seconds() - before_s) * NS_PER_S)


@pytest.fixture
async def open_stand(tmp_path: Path) -> AsyncGenerator[tuple[IdleLog, Hub, Calendar]]:
    hub, clock = Hub(), Calendar()
    devices = SimpleNamespace(every={}, cameras={})
    assembly = cast("Assembly", SimpleNamespace(hub=hub, clock=clock, devices=devices, config=load_config(CONFIG)))
    record = IdleLog(assembly, {"config.yaml": CONFIG.read_text("utf-8")}, tmp_path, clock, ShutdownDeadline())
    yield record, hub, clock
    await record.end(20.0)


async def publish(hub: Hub, clock: Calendar, published: list[int]) -> None:
    """A reading each few milliseconds, all that time."""
    while True:
        published.append(clock.now_ns())
        hub.publish(Batch("thermometers", published[-1], (Reading("thermometers.air", 24.0, "degC", published[-1]),)))
        await asyncio.sleep(0.004)


def times_ns(session: Session) -> list[int]:
    return [int(time_ns) for time_ns in session.readings("thermometers.air")[0]]


async def test_at_midnight_each_reading_is_in_one_of_two_sessions(
    open_stand: tuple[IdleLog, Hub, Calendar], tmp_path: Path
):
    record, hub, clock = open_stand
    clock.go_to_midnight(60.0)
    published: list[int] = []
    publishing = asyncio.create_task(publish(hub, clock, published))
    yesterday = await record.begin()
    clock.go_to_midnight(0.3)  # not before: a busy computer takes longer than that to begin
    while record.is_of_today():
        await asyncio.sleep(0.01)
    today = await record.begin()
    assert record.recorder is today
    assert record.is_of_today()
    await record.complete(20.0)
    await asyncio.sleep(0.1)
    publishing.cancel()
    await asyncio.gather(publishing, return_exceptions=True)
    await record.end(20.0)
    first, second = Session.open(yesterday.directory), Session.open(today.directory)
    assert first.path.name < second.path.name
    recorded = times_ns(first) + times_ns(second)
    assert recorded == [time_ns for time_ns in published if time_ns >= recorded[0]]
    assert len(times_ns(first)) > 10 < len(times_ns(second))
    for session in (first, second):
        assert session.incomplete == ()
        assert [event.kind for event in session.events()].count(RUN_END) == 1
        found = verify(session.path)  # only the thermometers were read here
        assert found.holes == ()
        assert {each.files for each in found.findings} <= {Files.INCOMPLETE, Files.SOUND}
    assert sorted(path.name for path in tmp_path.iterdir()) == [first.path.name, second.path.name]


async def test_yesterdays_record_goes_on_when_todays_cannot_be_begun(
    open_stand: tuple[IdleLog, Hub, Calendar], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    record, _, clock = open_stand
    clock.go_to_midnight(-1.0)  # a second after it
    yesterday = await record.begin()
    clock.go_to_midnight(-1.0)

    def no_place(self: object, day: str) -> str:
        raise SessionError("the disk is full")

    monkeypatch.setattr(IdleLog, "_find_session", no_place)
    with pytest.raises(SessionError):
        await record.begin()
    assert record.recorder is yesterday
    assert not record.is_of_today()


async def test_old_records_between_runs_are_removed_but_none_with_a_note_or_a_tag(
    open_stand: tuple[IdleLog, Hub, Calendar], tmp_path: Path
):
    record, hub, clock = open_stand
    warned: list[Event] = []
    hub.subscribe(lambda item: warned.append(item) if isinstance(item, Event) else None)
    names: list[str] = []
    for _ in range(4):
        names.append((await record.begin()).directory.name)
        await record.end(20.0)
        clock.go_to_midnight(-60.0)
    for name in (names[1], names[3]):
        add_tags(tmp_path / name, ["keep"], "eva", 1)
    (tmp_path / names[3] / NOTES_NAME).write_bytes(b"a damaged line\n")
    for name in ("20200101-overnight", "20200101-idle-log"):  # a run's, and a folder that is no session
        (tmp_path / name).mkdir()
    today = f"{datetime.fromtimestamp(clock.now_ns() / NS_PER_S):%Y%m%d}"
    assert remove_idle_logs(tmp_path, today, 30) == []
    clock.ahead_ns += 91 * 24 * 3600 * NS_PER_S
    latest = (await record.begin()).directory.name
    while not any(event.kind == "idle_logs_removed" for event in warned):
        await asyncio.sleep(0.01)
    assert next(event for event in warned if event.kind == "idle_logs_removed").data["names"] == [names[0], names[2]]
    kept = sorted(path.name for path in tmp_path.iterdir())
    assert kept == sorted(["20200101-idle-log", "20200101-overnight", names[1], names[3], latest])
