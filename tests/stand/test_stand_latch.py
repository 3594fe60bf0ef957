"""A stand's latch: on the disk before anything is reported, found again, and not taken for none when it is
unreadable."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import SessionError
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.opening.stand_lock import find_latch_file
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.latch import UNREADABLE, WITHIN_S, LatchFile, find_state_folder

FAULT = Fault("over_temperature", "thermometers.air is 61.00 degC")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "bus.latched.json"


def test_what_was_kept_is_found_by_another_program_until_it_is_cleared(path: Path):
    assert LatchFile([path]).read() is None
    assert LatchFile([path]).keep(FAULT, 5) == ""
    found = LatchFile([path]).read()
    assert found is not None
    assert (found.rule, found.text, found.since_ns) == (FAULT.rule, FAULT.text, 5)
    assert LatchFile([path]).remove() == ""
    assert LatchFile([path]).read() is None
    LatchFile([path]).reset()


def whole(path: Path) -> bytes:
    LatchFile([path]).keep(FAULT, 5)
    return path.read_bytes()


def halved(path: Path) -> None:
    path.write_bytes(whole(path)[:20])


def zeroed(path: Path) -> None:
    path.write_bytes(bytes(len(whole(path))))


def nulled(path: Path) -> None:
    path.write_text('{"rule": null, "text": "x", "since_ns": 5}')


def of_an_earlier_fault(path: Path) -> None:
    """A sector of the file as it was before, at the begin of what is there now."""
    path.write_bytes(whole(path).replace(b"61.00", b"58.00"))


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def linked(path: Path) -> None:
    path.symlink_to(path.with_name("nowhere"))


def made_a_folder(path: Path) -> None:
    path.mkdir()


def of_another_shape(path: Path) -> None:
    path.write_text("[]")


SPOILT = [halved, zeroed, nulled, of_an_earlier_fault, emptied, linked, made_a_folder, of_another_shape]


@pytest.mark.parametrize("spoil", SPOILT)
def test_one_that_cannot_be_read_counts_as_latched_and_can_be_cleared(path: Path, spoil: Callable[[Path], None]):
    path.parent.mkdir()
    spoil(path)
    found = LatchFile([path]).read()
    assert found is not None
    assert found.rule == UNREADABLE
    assert str(path) in found.text
    LatchFile([path]).reset()
    assert LatchFile([path]).read() is None


def test_one_that_cannot_be_cleared_stays_and_is_named(path: Path):
    path.mkdir(parents=True)
    (path / "something").touch()
    with pytest.raises(SessionError, match="the stand stays latched"):
        LatchFile([path]).reset()


def test_a_disk_that_hangs_keeps_the_guard_waiting_for_a_moment_only(path: Path):
    latch, hanging = LatchFile([path]), threading.Event()
    latch.run = lambda *_: hanging.wait()
    assert WITHIN_S <= 0.25
    assert "not answered" in latch.keep(FAULT, 5)
    hanging.set()


def test_a_process_that_has_ended_is_done_without(path: Path):
    latch = LatchFile([path])

    def ended(*_: object) -> object:
        raise BrokenPipeError(32, "the process that writes the session to the disk has ended")

    latch.run = ended
    assert latch.keep(FAULT, 5) == ""
    assert LatchFile([path]).read() is not None


def test_it_belongs_to_what_heats_and_not_to_a_name_or_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    data = yaml.safe_load(find_packaged("", "simulated").read_text())

    def of(**changes: object) -> LatchFile:
        return find_latch_file(parse_document(yaml.safe_dump(data | changes), StandConfig, "stand.yaml"))

    assert of().keep(FAULT, 5) == ""
    assert of(name="another", recording={"directory": "/elsewhere"}).read() is not None
    assert of(axes={}, cameras={}).read() is not None
    assert of(bus=data["bus"] | {"address": "tcp:127.0.0.1:5999"}).read() is None
    assert find_state_folder() == tmp_path / "thermostand"
    for path in find_state_folder().iterdir():  # a disk that has forgotten any one of its files
        content = path.read_bytes()
        path.unlink()
        assert of().read() is not None
        path.write_bytes(content)
    assert of().remove() == ""
    assert list(find_state_folder().iterdir()) == []
