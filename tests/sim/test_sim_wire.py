"""The simulator's ends of serial lines: one path is one simulator's."""

import os
from pathlib import Path

import pytest

from thermostand.drivers.sim.wire import LinkFaults, PtyWire


class Echo:
    def feed(self, data: bytes) -> bytes:
        return data


def plugged(path: Path) -> PtyWire:
    return PtyWire(path, Echo(), LinkFaults())


def test_a_line_that_another_simulator_answers_at_is_refused_and_goes_on(tmp_path: Path):
    first = plugged(tmp_path / "linear")
    terminal = os.readlink(tmp_path / "linear")
    with pytest.raises(OSError, match=rf"serial:{tmp_path}/linear"):
        plugged(tmp_path / "linear")
    assert os.readlink(tmp_path / "linear") == terminal
    first.unplug()
    with pytest.raises(OSError, match="another simulator"):  # it is unplugged for a while only
        plugged(tmp_path / "linear")
    first.close()
    plugged(tmp_path / "linear").close()


def test_a_link_that_a_killed_simulator_has_left_is_taken_over(tmp_path: Path):
    (tmp_path / "linear").symlink_to("/dev/pts/gone")
    plugged(tmp_path / "linear").close()
    assert not (tmp_path / "linear").is_symlink()


def test_what_is_no_simulators_is_not_replaced(tmp_path: Path):
    (tmp_path / "ttyUSB0").write_text("a port")
    with pytest.raises(OSError, match="no line of"):
        plugged(tmp_path / "ttyUSB0")
    assert (tmp_path / "ttyUSB0").read_text() == "a port"
