"""A session during which the system clock was stepped: recorded instants stay, what is shown and exported is UTC."""

import asyncio
import csv
import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.recording.full_session import START_NS, make_half_second, record
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import CLOCK_STEP
from thermostand.foundation.items import Event
from thermostand.recording.reading.scan import verify
from thermostand.recording.reading.session import Session
from thermostand.stand.commands.sessions.session_commands import app

HOUR_NS = 3600 * NS_PER_S
STEPPED = 9  # the half second of 12 at which the system clock was set an hour forward, after 4.5 s
STEPPED_NS = START_NS + STEPPED * NS_PER_S // 2


def stepped(time_ns: int, index: int):
    yield from make_half_second(time_ns, index)
    if index == STEPPED:
        data = {"offset_before_ns": 0, "offset_after_ns": HOUR_NS, "stand_ns": time_ns, "utc_ns": time_ns + HOUR_NS}
        yield Event(time_ns, "warning", CLOCK_STEP, "the system clock was stepped", data)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("sessions") / "cycle"
    asyncio.run(record(directory, 12, stepped))
    return directory


def ask(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_list_and_info_show_utc_and_durations_of_the_stands_clock(session: Path):
    listed = ask("list", session.parent).splitlines()[1].split()
    assert listed[2:6] == ["2026-01-01", "18:00:00", "5.5", "s"]
    for reported in (json.loads(ask("list", session.parent, "--json"))[0], json.loads(ask("info", session, "--json"))):
        assert reported["start"].startswith("2026-01-01T18:00:00.")
        assert reported["end"] == "2026-01-01T19:00:05.623456789Z"
        assert (reported["begin_ns"] // NS_PER_S, reported["end_ns"]) == (
            START_NS // NS_PER_S,
            START_NS + 11 * NS_PER_S // 2,
        )
        assert reported["duration_s"] < 6
    lines = " ".join(ask("info", session).split())
    assert "recorded 2026-01-01 18:00:00 to 2026-01-01 19:00:05 UTC, 5.5 s, wall clock" in lines
    assert "2026-01-01 18:00:04 warning: half second 8" in lines
    assert "2026-01-01 19:00:04 warning: " in lines
    assert "step 11 1 of 1 frames from 2026-01-01 19:00:05" in lines


def test_an_export_keeps_the_recorded_instant_and_the_utc_of_then(session: Path, tmp_path: Path):
    ask("export", session, "--out", tmp_path / "out")
    tables = [*(tmp_path / "out").glob("*.csv"), *(tmp_path / "out").glob("*/*.csv")]
    assert len(tables) == 9  # steps, events, frames, their index, five devices
    for path in tables:
        times = [(int(row["time_ns"]), row["time_utc"]) for row in table(path)]
        assert times
        for time_ns, utc in times:
            assert utc[11:13] == ("19" if time_ns >= STEPPED_NS else "18"), path
    (step,) = (row for row in table(tmp_path / "out" / "events.csv") if row["kind"] == CLOCK_STEP)
    assert json.loads(step["data_json"])["offset_after_ns"] == HOUR_NS
    assert (
        "time_utc: 2026-01-01T19:00:05.073456789Z\ntime_ns: 1767290405073456789\n"
        in (tmp_path / "out" / "frames" / "000011.txt").read_text()
    )


def test_a_replay_tells_utc(session: Path):
    lines = ask("replay", session, "--speed", "max").splitlines()
    assert [line[:19] for line in lines if "half second" in line][STEPPED - 1 : STEPPED + 2] == [
        "2026-01-01 18:00:04",
        "2026-01-01 19:00:04",
        "2026-01-01 19:00:05",
    ]


def test_a_part_is_cut_by_utc_and_knows_its_own(session: Path, tmp_path: Path):
    cut = ("trim", session, "--from", "2026-01-01T19:00:05", "--to", "2026-01-01T19:00:05.5")
    part = Path(ask(*cut, "--out", tmp_path / "part").strip())
    assert Session.open(part).frame_times_ns.tolist() == [START_NS + 5 * NS_PER_S - 50_000_000]
    assert Session.open(part).utc.at(START_NS + 5 * NS_PER_S) == HOUR_NS
    assert ask("list", tmp_path).splitlines()[1].split()[2:4] == ["2026-01-01", "19:00:05"]
    (reported,) = (event for event in Session.open(part).events() if event.kind == "session.trimmed")
    assert "2026-01-01T19:00:05.000000000Z up to 2026-01-01T19:00:05.500000000Z" in reported.text
    assert verify(part).is_sound


def test_what_verify_finds_is_reported_in_utc(session: Path, tmp_path: Path):
    damaged = Path(shutil.copytree(session, tmp_path / "cycle"))
    for segment in sorted((damaged / "frames").iterdir())[-1:]:
        segment.unlink()
    reported = "\n".join(map(str, verify(damaged).findings))
    assert "2026-01-01 18:00:04 to 2026-01-01 19:00:05 UTC" in reported
