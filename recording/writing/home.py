"""The folder a series is written into, known again by device and inode: a folder of the same name is another one."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from thermostand.foundation.files import make_durable_folder, sync_folder


class FolderLost(OSError):
    """The folder is not where it was when the recording began: removed, renamed, or another one has its name."""


class Home:
    """One folder, held by a descriptor from its making on. Blocking; raises OSError when the disk refuses it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._fd = self._made()

    def check(self) -> None:
        """FolderLost when the folder of this name is not this one any more; any OSError when it cannot be asked."""
        try:
            found = self._folder.stat()
        except (FileNotFoundError, NotADirectoryError):
            found = None
        if found is None or not os.path.samestat(found, os.fstat(self._fd)):
            raise FolderLost(errno.ENOENT, f"the folder {self._folder} {self._fate()}")

    def refound(self) -> bool:
        """After a FolderLost: whether the folder is back; else one is made at its place."""
        with suppress(FolderLost):
            self.check()
            return True
        lost, self._fd = self._fd, self._made()
        os.close(lost)
        return False

    def _made(self) -> int:
        """A descriptor of the folder at this place, which is made where there is none, durably."""
        make_durable_folder(self._folder)
        for folder in (self._folder.parent, self._folder.absolute().parent.parent):
            sync_folder(folder)
        return os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)

    def _fate(self) -> str:
        """What has become of the folder, as the kernel knows it."""
        if not os.fstat(self._fd).st_nlink:
            return "was removed while it was recorded into"
        with suppress(OSError):
            place = os.readlink(f"/proc/self/fd/{self._fd}")
            if place != os.path.realpath(self._folder):
                return f"was renamed while it was recorded into: it is {place} now"
        return "cannot be reached under its name any more"

    def close(self) -> None:
        """Let go of the folder; may be called twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)
