"""Every command on every damaged or hostile session (hostile_sessions.py): it answers soon, with a word or a sentence,
never a traceback, in little memory. What is short is a test; the whole table is run by night.
"""

import asyncio
import re
import shutil
from pathlib import Path

import pytest

from tests.recording.runs import record_run
from tests.stand.hostile_commands import Answer, commands
from tests.stand.hostile_sessions import NONE, ROWS, SOUND

MOST_BYTES = 1_500_000_000
LONGEST_S = 60.0  # of a machine that does four other things; 10 s of one that does not
SILENT_S = 30.0  # likewise: what takes longer shows how far it is
WITH_HOLES = ("telemetry missing in the middle", "frames missing in the middle", "the end missing", "no frames")

# Those that take a whole session, and what they make of it.
USES = {
    "replay": ("stand", "session", "replay", "SESSION", "--speed", "max", "--record", "OUT"),
    "export": ("stand", "session", "export", "SESSION", "--out", "OUT"),
    "trim": ("stand", "session", "trim", "SESSION", "--from", "+1s", "--out", "OUT"),
    "fit": ("compensate", "fit", "SESSION", "-o", "OUT", "--no-cache"),
    "report": ("compensate", "report", "SESSION", "-o", "OUT.html", "--no-cache"),
    "detect": ("compensate", "detect", "SESSION", "-o", "OUT.csv", "--target", "paper-9x6"),
}
LOOKS = {
    "list": ("stand", "session", "list", "FOLDER"),
    "info": ("stand", "session", "info", "SESSION"),
    "verify": ("stand", "session", "verify", "SESSION"),
}
CHANGES = {
    "resume": ("stand", "resume", "SESSION"),
    "repair": ("stand", "session", "repair", "SESSION"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete run of 20 frames in five segments of each series; not to be changed."""
    return asyncio.run(record_run(tmp_path_factory.mktemp("sessions") / "cycle-1"))


@pytest.fixture(scope="module")
def ask():
    with commands("thermostand.stand.commands.sessions.session_cli") as asking:
        yield asking


@pytest.fixture(scope="module")
def ask_all():
    with commands(
        "thermostand.stand.commands.sessions.session_cli", "thermostand.compensation.commands.fit_cli"
    ) as asking:
        yield asking


def made(whole: Path, tmp_path: Path, row: str) -> Path:
    session = Path(shutil.copytree(whole, tmp_path / "sessions" / whole.name))
    ROWS[row].make(session)
    return session


def words(command: tuple[str, ...], session: Path, out: Path) -> list[str]:
    places = {"SESSION": str(session), "FOLDER": str(session.parent)}
    return [places.get(word, word.replace("OUT", str(out))) for word in command]


def check(name: str, answer: Answer) -> None:
    """What holds for every command and every session."""
    assert answer.status in (0, 1, 2), (name, answer)
    assert "Traceback" not in answer.output, (name, answer)
    assert answer.output.strip(), name
    assert answer.memory_bytes < MOST_BYTES, (name, answer)
    assert answer.seconds < LONGEST_S, (name, answer)
    assert answer.seconds < SILENT_S or re.search(r"\d+%", answer.output), (name, answer)
    assert "\x1b" not in answer.output, (name, answer)
    if answer.status == 2:
        assert "error: " in answer.output, (name, answer)


def check_verified(answer: Answer, expected: str) -> None:
    """The word for the files."""
    if expected == NONE:
        assert answer.status == 2, answer
        return
    assert re.findall(r"^files (\w+)", answer.output, re.MULTILINE) == [expected], answer
    assert answer.status == (expected != SOUND), answer


@pytest.mark.parametrize("row", [name for name, row in ROWS.items() if not row.nightly])
def test_a_hostile_session_has_its_word_soon(row: str, whole: Path, tmp_path: Path, ask):
    session = made(whole, tmp_path, row)
    answer = ask(*words(LOOKS["verify"], session, tmp_path / "out"))
    check("verify", answer)
    check_verified(answer, ROWS[row].files)


@pytest.mark.nightly
@pytest.mark.parametrize("row", ROWS)
def test_every_command_answers_on_a_hostile_session(row: str, whole: Path, tmp_path: Path, ask_all):
    session = made(whole, tmp_path, row)
    for name, command in (LOOKS | USES | CHANGES).items():
        out = tmp_path / f"made-by-{name}"
        answer = ask_all(*words(command, session, out))
        check(name, answer)
        if name == "verify":
            check_verified(answer, ROWS[row].files)
        if name in USES:
            assert answer.status == 0 or not out.exists(), (name, answer)
            assert list(tmp_path.glob("*.part")) == [], (name, answer)
        if name in USES and row in WITH_HOLES:
            assert answer.status in (1, 2), (name, answer)
            assert "--incomplete" in answer.output, (name, answer)
    again = ask_all(*words(CHANGES["repair"], session, tmp_path / "out"))
    check("salvage, once more", again)
    assert again.status in (0, 2), again  # what a first salvage could not recover a second one does not find
    check("verify, once more", ask_all(*words(LOOKS["verify"], session, tmp_path / "out")))
