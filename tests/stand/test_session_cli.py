import asyncio
import fcntl
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.recording.full_session import START_NS, item_key, make_half_second, record
from tests.stand.session_commands import COUNT, ask, read_refusal
from thermostand.foundation.items import Event
from thermostand.recording.format.records import list_frame_places
from thermostand.recording.reading.session import Session
from thermostand.stand.commands.sessions.session_table import fit_columns, format_lines


def flip_in_frame(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[list_frame_places(path)[1].chunk.offset + 150] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    "command", ["list", "note", "tag", "archive", "info", "verify", "repair", "replay", "export", "trim"]
)
def test_every_command_explains_itself_with_an_example(command: str):
    assert f"Example: stand session {command}" in " ".join(ask(command, "--help").stdout.split())


def test_the_list_has_a_line_for_each_session_and_for_a_damaged_one(session: Path):
    damaged = Path(shutil.copytree(session, session.parent / "z-damaged"))
    (damaged / "telemetry" / "0001.mcap").write_bytes(b"")
    shutil.copytree(session / "frames", session.parent / "y-running" / "frames", copy_function=_as_part)
    (session.parent / "no-session").mkdir()
    (session.parent / "notes.txt").write_text("a cloudy night")
    header, *lines = ask("list", session.parent).stdout.splitlines()
    assert header.split() == [
        "session",
        "recipe",
        "start",
        "(local)",
        "duration",
        "frames",
        "size",
        "devices",
        "run",
        "files",
    ]
    running, first, last = (line.split(maxsplit=8) for line in lines)  # the one without a known start is first
    assert (running[0], running[1]) == ("y-running", "thermal_cycle")
    assert (
        "interrupted  incomplete: frames/0000.mcap.part: is not finished; `stand session repair` recovers what"
        in lines[0]
    )
    assert first[:6] == [session.name, "thermal_cycle", "2026-01-01", "18:00:00", "5.5", "s"]
    assert first[6] == "12"
    assert lines[1].endswith("real     interrupted  sound")
    assert last[0] == "z-damaged"
    assert "damaged: telemetry/0001.mcap: " in lines[2]


def _as_part(source: str, target: str) -> str:
    return shutil.copy(source, f"{target}.part")


def test_the_list_as_json(session: Path):
    (listed,) = json.loads(ask("list", session.parent, "--json").stdout)
    assert listed["name"] == session.name
    assert (listed["frames"], listed["run"], listed["files"]) == (COUNT, "interrupted", "sound")
    assert listed["simulated"] is False
    assert listed["start"] == "2026-01-01T18:00:00.073456789Z"  # the first frame's middle, half of its exposure ago
    assert listed["bytes"] == sum(path.stat().st_size for path in session.rglob("*.mcap"))
    assert {entry["file"].partition("/")[0] for entry in listed["segments"]} == {"telemetry", "frames"}
    assert json.loads(ask("list", session, "--json").stdout) == [listed]  # a session is a list of itself


def test_notes_and_tags_are_listed_and_found(session: Path):
    other = Path(shutil.copytree(session, session.parent / "other"))
    assert "tags" not in ask("list", session.parent).stdout
    ask("note", session, "door", "opened")
    assert ask("tag", session, "paper", "lens-B").stdout == f"{session}: 1 note, tags: paper, lens-B\n"
    ask("tag", other, "paper")
    assert json.loads(ask("list", session.parent, "--tag", "paper", "--tag", "lens-B", "--json").stdout)[0]["tags"] == [
        "paper",
        "lens-B",
    ]
    header, line = ask("list", session.parent, "--tag", "lens-B").stdout.splitlines()
    assert header.split()[-2:] == ["tags", "note"]
    assert line.endswith("paper,lens-B  door opened")
    ask("tag", session, "lens-B", "--remove")
    assert "tag lens-B" in ask("list", session.parent, "--tag", "lens-B").stderr
    answer = ask("info", session).stdout
    assert "tags          paper" in answer
    assert ": door opened" in answer
    assert "one word" in read_refusal("tag", session, "two words")
    assert ask("verify", session).stdout.endswith("read\n")


def test_a_session_that_is_being_recorded_takes_a_note(session: Path):
    growing = session / "telemetry" / "0009.mcap.part"
    growing.write_bytes(b"")
    with growing.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        ask("note", session, "watch the flap")
        (listed,) = json.loads(ask("list", session.parent, "--json").stdout)
    assert (listed["run"], listed["notes"][0]["text"]) == ("running", "watch the flap")
    assert listed["notes"][0]["by"]


def test_a_list_of_known_sessions_imports_nothing_that_takes_time(session: Path):
    ask("list", session.parent)
    code = (
        "import sys\nfrom stand.commands.sessions.session_commands import app\n"
        f"try: app(['list', {str(session.parent)!r}])\nexcept SystemExit as end: assert not end.code\n"
        "assert not {'numpy', 'google.protobuf', 'mcap', 'asyncio', 'rich.console'} & {*sys.modules}, sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, session.name in done.stdout) == (0, True), done.stderr


def test_a_folder_without_sessions_and_no_folder(tmp_path: Path):
    assert "no sessions there" in ask("list", tmp_path).stderr
    assert "no such folder" in read_refusal("list", tmp_path / "nowhere")
    (tmp_path / "cycle.mcap").write_bytes(b"")
    assert "cycle.mcap: is a file" in read_refusal("list", tmp_path / "cycle.mcap")


def test_a_folder_of_sessions_is_no_session_and_says_which_command_shows_them(session: Path):
    for command in ("info", "verify"):
        line = read_refusal(command, session.parent)
        assert line.startswith(f"error: {session.parent}: ")
        assert f"`stand session list {session.parent}`" in line


def test_info_tells_a_person_what_was_recorded(session: Path):
    output = ask("info", session).stdout
    assert max(map(len, output.splitlines())) <= 100
    answer = " ".join(output.split())
    for fact in (
        f"session {session.name}, recorded as cycle-1",
        "run interrupted",
        "files sound",
        "recipe thermal_cycle",
        "recorded 2026-01-01 18:00:00 to 2026-01-01 18:00:05 UTC, 5.5 s, wall clock",
        "ended not recorded",
        "operator M. Adamczyk",
        "camera DA1234567",
        "software thermostand 0.1.0, host laboratory",
        "attached config.yaml, target.yaml",
        "steps 12 done: 12 capture",
        "frames 12, 40 x 30 px, 8 bit, ",
        "6 lost by the camera or its wire",
        "step 3 1 of 1 frames from 2026-01-01 18:00:01",
        "thermometers.air degC 20 20.805 21.571 12 1",
        "gaps none",
        "events 12 warning",
        "2026-01-01 18:00:02 warning: half second 4, 5 µm",
    ):
        assert fact in answer


def test_info_tells_what_the_recorder_lost(tmp_path: Path):
    def items(time_ns: int, index: int):
        yield from make_half_second(time_ns, index)
        yield Event(time_ns, "error", "frames_dropped", "frames lost: 1", {"blocks": [[index, index]]})

    asyncio.run(record(tmp_path / "s", 3, items=items))
    answer = " ".join(ask("info", tmp_path / "s").stdout.split())
    assert "; 1 lost by the camera" in answer


def test_info_as_json_has_everything_and_no_nan(session: Path):
    def fail(name: str) -> None:
        pytest.fail(f"{name} is not JSON")

    found = json.loads(ask("info", session, "--json").stdout, parse_constant=fail)
    assert found["metadata"]["camera_serial"] == "DA1234567"
    assert len(found["steps"]) == len(found["events"]) == COUNT
    assert found["steps"][4]["parameters"] == {"frames": 1, "interval_s": 0.5}
    assert (found["images"]["count"], found["images"]["dropped"]) == (COUNT, 6)
    (air,) = [row for row in found["channels"] if row["channel"] == "thermometers.air"]
    assert (air["unit"], air["count"], air["bad"], air["min"]) == ("degC", COUNT, 1, 20.0)


def test_info_says_what_is_unfinished_and_what_to_do(session: Path):
    path = session / "frames" / "0001.mcap"
    path.rename(path.with_name("0001.mcap.part"))
    answer = " ".join(ask("info", session).stdout.split())
    assert "files incomplete" in answer
    assert "frames/0001.mcap.part is unfinished (" in answer
    assert f"stand session repair {session}" in answer


def test_verify_tells_what_was_lost_before_the_recording_and_that_the_session_is_sound(session: Path):
    lines = ask("verify", session).stdout.splitlines()
    reasons = [line.partition(" lost by ")[0] for line in lines[:-1]]
    assert reasons == [f"note: 1 frame of step {k} (capture)" for k in range(2, 13, 2)]
    assert lines[-1].startswith("files sound; run interrupted; 7 segments, 143 messages, 12 frames, ")


def test_verify_fails_with_a_sentence_for_each_damage(session: Path):
    flip_in_frame(session / "frames" / "0000.mcap")
    (session / "telemetry" / "0001.mcap").unlink()
    lines = ask("verify", session, status=1).stdout.splitlines()
    assert "error: telemetry/0001.mcap: is missing" in lines
    assert any(line.startswith("error: frames/0000.mcap: is damaged: ") for line in lines)
    assert lines[-1].startswith("files damaged (")
    found = json.loads(ask("verify", session, "--json", status=1).stdout)
    assert found["sound"] is False
    assert {
        "severity": "error",
        "where": "telemetry/0001.mcap",
        "text": "is missing",
        "files": "incomplete",
    } in found["findings"]


def test_salvage_finishes_what_is_unfinished_in_every_session(session: Path):
    whole = Path(shutil.copytree(session, session.parent / "other"))
    path = session / "frames" / "0001.mcap"
    path.rename(path.with_name("0001.mcap.part"))
    (line,) = ask("repair", session.parent).stdout.splitlines()
    assert line.startswith(f"{session.name}/frames/0001.mcap.part: 8 messages in 0001.mcap (")
    assert Session.open(session).frame_count == Session.open(whole).frame_count == COUNT
    assert ask("repair", session).stdout == "nothing to repair\n"


def test_salvage_fails_when_something_is_lost_and_keeps_the_original(session: Path):
    flip_in_frame(session / "frames" / "0001.mcap")
    (line,) = ask("repair", session, status=1).stdout.splitlines()
    assert f"{session.name}/frames/0001.mcap: 6 messages in 0001.mcap, " in line
    assert "kept as 0001.mcap.damaged" in line


def items(directory: Path) -> list[object]:
    return [item_key(item) for item in Session.open(directory).items()]


@pytest.mark.parametrize("speed", ["max", "200"])
def test_a_replay_is_recorded_with_the_same_items(session: Path, tmp_path: Path, speed: str):
    result = ask("replay", session, "--speed", speed, "--record", tmp_path / "again")
    assert result.stdout.splitlines()[-1] == str(tmp_path / "again")
    assert items(tmp_path / "again") == items(session)


@pytest.mark.parametrize("speed", ["max", "200"])
def test_a_replay_prints_steps_and_events_as_they_come(session: Path, speed: str):
    lines = ask("replay", session, "--speed", speed).stdout.splitlines()
    assert lines[:3] == [
        "2026-01-01 18:00:00  step 1 capture started",
        "2026-01-01 18:00:00  step 1 capture done",
        "2026-01-01 18:00:00  warning note: half second 0, 5 µm",
    ]
    assert len(lines) == 3 * COUNT


def test_a_replay_gives_programs_steps_and_events_one_a_line(session: Path):
    reported = [json.loads(line) for line in ask("replay", session, "--speed", "max", "--json").stdout.splitlines()]
    assert len(reported) == 3 * COUNT
    assert [each["kind"] for each in reported[:3]] == ["capture", "capture", "note"]
    assert (reported[0]["state"], reported[2]["text"]) == ("started", "half second 0, 5 µm")


@pytest.mark.parametrize("speed", ["0", "-1", "fast", "nan", "1e9", ""])
def test_a_speed_is_a_number_or_max(session: Path, speed: str):
    assert "from 0.001 to 1000000" in read_refusal("replay", session, f"--speed={speed}")


def test_export_writes_images_and_tables(session: Path, tmp_path: Path):
    assert ask("export", session, "--out", tmp_path / "files").stdout.strip() == str(tmp_path / "files")
    assert len(list((tmp_path / "files" / "frames").glob("*.png"))) == COUNT
    assert list((tmp_path / "files" / "telemetry").glob("*.csv"))
    ask("export", session, "--out", tmp_path / "bare", "--no-frames", "--no-telemetry")
    assert sorted(path.name for path in (tmp_path / "bare").iterdir()) == [
        "README.txt",
        "attachments",
        "events.csv",
        "frames.csv",
        "ro-crate-metadata.json",
        "session.json",
        "steps.csv",
    ]


def test_export_writes_one_file_for_a_viewer(session: Path, tmp_path: Path):
    out = tmp_path / "cycle.mcap"
    assert ask("export", session, "--out", out, "--format", "mcap").stdout == f"{out}\n"
    assert out.read_bytes()[:5] == b"\x89MCAP"
    assert (tmp_path / f"{out.name}-ro-crate-metadata.json").is_file()
    assert ask("import", out, "--out", tmp_path / "again").stdout == f"{tmp_path / 'again'}\n"
    assert "files sound" in ask("verify", session).stdout
    assert "12 frames" in ask("verify", tmp_path / "again").stdout
    assert "no such file" in read_refusal("import", tmp_path / "x.mcap", "--out", tmp_path / "y")
    assert "exists already" in read_refusal("import", out, "--out", tmp_path / "again")
    assert "exists already" in read_refusal("export", session, "--out", out, "--format", "mcap")


def test_trim_takes_times_offsets_and_steps(session: Path, tmp_path: Path):
    parts = {
        "offset": ("--from", "+1s", "--to", "+3s"),
        "time": ("--from", "2026-01-01T18:00:01.073456", "--to", "2026-01-01T18:00:03.073456"),
        "step": ("--from", "step:3", "--to", "step:7"),
    }
    for name, times in parts.items():
        assert ask("trim", session, "--out", tmp_path / name, *times).stdout.strip() == str(tmp_path / name)
    frames = {name: Session.open(tmp_path / name).frame_times_ns.tolist() for name in parts}
    assert frames["offset"] == frames["time"]
    middles_ns = [START_NS + k * 500_000_000 - 50_000_000 for k in range(COUNT)]
    assert frames["offset"] == middles_ns[2:6]
    assert frames["step"] == middles_ns[3:7]  # a step begins half an exposure after the middle of its first frame
    ask("trim", session, "--out", tmp_path / "all")
    assert Session.open(tmp_path / "all").frame_count == COUNT


@pytest.mark.parametrize(
    ("times", "sentence"),
    [
        (("--from", "noon"), "noon: expected a time such as"),
        (("--from", "step:77"), "step:77: the session has no step 77"),
        (("--from", "+3s", "--to", "+1s"), "--to +1s is not after --from +3s"),
        (("--from", "+1h"), "--from +1h is after the session's end (2026-01-01 18:00:05 UTC)"),
        (("--to", "+99999999h"), "+99999999h: is not between the years 1970 and 9999"),
        (("--from", "+9999999999999999999999h"), "h: is not between the years 1970 and 9999"),
    ],
)
def test_trim_refuses_times_that_are_none(session: Path, tmp_path: Path, times: tuple[str, ...], sentence: str):
    assert sentence in read_refusal("trim", session, "--out", tmp_path / "part", *times)
    assert not (tmp_path / "part").exists()


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_names_of_sessions_are_whole_however_narrow_the_terminal_is(width: int):
    columns = ("session", "recipe", "start (local)", "duration", "frames", "size", "devices", "run", "files", "note")
    row = ("20260101T180000Z-thermal-cycle", "thermal_cycle", "2026-01-01 19:00:00", "11:02:03", "3914", "1.2 GB")
    table = [(*row, "simulated", "complete", "sound", "a" * 40)]
    kept, cells, left_out = fit_columns(columns, table, width)
    assert [column for column in columns if column in {*kept, *left_out}] == list(columns)
    assert (kept[0], kept[-2:], cells[0][0]) == ("session", kept[-2:], row[0])
    assert {"run", "files"} <= set(kept)
    assert bool(left_out) is (width < 200)
    if width >= 60:
        assert max(map(len, format_lines(kept, cells))) <= width
