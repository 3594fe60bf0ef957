"""What may be replaced by a file, and what may not: a rename over a device node would destroy the node."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import check_folder_writable, check_writable, make_folder, whole_file, write_whole


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    """Stands for a device node: as little a regular file, and harmless."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    return path


def test_a_pipe_is_refused_and_stays_a_pipe(pipe: Path):
    for write in (check_writable, lambda path: write_whole(path, "text")):
        with pytest.raises(SessionError, match=r"pipe: cannot be written \(it is not a regular file\)"):
            write(pipe)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert list(pipe.parent.iterdir()) == [pipe]


def test_a_link_to_a_pipe_is_refused_too(pipe: Path):
    link = pipe.with_name("link")
    link.symlink_to(pipe)
    with pytest.raises(SessionError, match="link: cannot be written"):
        write_whole(link, "text")
    assert link.is_symlink()


def test_a_folder_is_refused(tmp_path: Path):
    (tmp_path / "folder").mkdir()
    for write in (check_writable, lambda path: write_whole(path, "text")):
        with pytest.raises(SessionError, match=r"folder: cannot be written \(it is a folder\)"):
            write(tmp_path / "folder")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_pipe_that_appears_during_the_work_is_refused_at_the_rename(tmp_path: Path):
    out = tmp_path / "out"

    def write() -> None:
        with whole_file(out) as file:
            file.write("text")
            os.mkfifo(out)

    with pytest.raises(SessionError, match="it is not a regular file"):
        write()
    assert stat.S_ISFIFO(out.stat().st_mode)
    assert list(tmp_path.iterdir()) == [out]


def test_a_file_is_replaced_when_the_block_has_ended_and_not_before(tmp_path: Path):
    out = tmp_path / "out"
    out.write_text("older")
    with whole_file(out) as file:
        file.write("a\r\nb\n")
        assert out.read_text() == "older"
    assert out.read_bytes() == b"a\r\nb\n"
    assert list(tmp_path.iterdir()) == [out]


def test_a_folder_is_made_when_it_is_needed_and_not_before(tmp_path: Path):
    wanted = tmp_path / "a" / "b"
    check_folder_writable(wanted, ["x"])
    assert not list(tmp_path.iterdir())
    make_folder(wanted)
    make_folder(wanted)
    check_folder_writable(wanted, ["x"])
    (wanted / "x").mkdir()
    with pytest.raises(SessionError, match="it is a folder"):
        check_folder_writable(wanted, ["x"])
    (tmp_path / "file").touch()
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for path in (tmp_path / "file", tmp_path / "file" / "b", tmp_path / "dangling"):
        with pytest.raises(SessionError, match="cannot be made"):
            check_folder_writable(path, ["x"])
