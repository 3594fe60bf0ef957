"""Real disks for tests: small, full, frozen or with attributes; what the kernel refuses here, it refuses anywhere."""

import os
import resource
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


def run(*command: str | Path) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)


def require(*programs: str) -> None:
    """Skip the test where a disk cannot be made and mounted."""
    if os.geteuid() != 0:
        pytest.skip("making and mounting a disk needs root")
    missing = [program for program in programs if shutil.which(program) is None]
    if missing:
        pytest.skip(f"there is no {' and no '.join(missing)} here")


@contextmanager
def mount(folder: Path, *arguments: str | Path) -> Iterator[Path]:
    """`mount ARGUMENTS folder`; skips the test where that is not allowed."""
    require("mount", "umount")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        run("mount", *arguments, folder)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no disk can be mounted here: {error.stderr.strip()}")
    try:
        yield folder
    finally:
        run("umount", "--lazy", folder)  # a failed test may still have a file open there


def tmpfs(folder: Path, size: str):
    """A disk of that size in memory."""
    return mount(folder, "-t", "tmpfs", "-o", f"size={size}", "tmpfs")


@contextmanager
def ext4(folder: Path, size_bytes: int) -> Iterator[Path]:
    """An ext4 disk of that size in a file beside `folder`."""
    require("mkfs.ext4", "chattr", "fsfreeze")
    image = folder.with_suffix(".img")
    image.touch()
    os.truncate(image, size_bytes)
    run("mkfs.ext4", "-q", "-F", image)
    with mount(folder, "-o", "loop", image):
        yield folder
    image.unlink()


def limit_files(size_bytes: int | None = None) -> None:
    """The kernel refuses to let a file of this process grow beyond that (EFBIG), like a full disk; None lifts it."""
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard if size_bytes is None else size_bytes, hard))
