"""Whether the folders of a session are still where they were, known again by device and inode (a folder of the same
name is another one), and what is reported when they are not."""

from __future__ import annotations

import asyncio
import errno
import os
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Protocol

from thermostand.foundation.events import FOLDER_BACK, FOLDER_LOST, FOLDER_NOT_MADE, RECORDING_LOST
from thermostand.foundation.files import make_durable_folder, sync_folder
from thermostand.foundation.items import Event
from thermostand.recording.format.layout import FRAMES, TELEMETRY

RecoverFolder = Callable[[], Awaitable[bool]]


class FolderLost(OSError):
    """The folder is not where it was when the recording began: removed, renamed, or another one has its name."""


class WatchedFolder:
    """One folder, held by a descriptor from its making on. Blocking; raises OSError when the disk refuses it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._fd = self._open_or_make()

    def check(self) -> None:
        """FolderLost when the folder of this name is not this one any more; any OSError when it cannot be asked."""
        try:
            found = self._folder.stat()
        except (FileNotFoundError, NotADirectoryError):
            found = None
        # By device and inode, since a folder of the same name may be another one: a removed one must not be made again
        # silently.
        if found is None or not os.path.samestat(found, os.fstat(self._fd)):
            raise FolderLost(errno.ENOENT, f"the folder {self._folder} {self._describe_loss()}")

    def recover(self) -> bool:
        """Return, after a FolderLost, whether the folder is back; else one is made at its place."""
        with suppress(FolderLost):
            self.check()
            return True
        lost, self._fd = self._fd, self._open_or_make()
        os.close(lost)
        return False

    def _open_or_make(self) -> int:
        """A descriptor of the folder at this place, which is made where there is none, durably."""
        make_durable_folder(self._folder)
        for folder in (self._folder.parent, self._folder.absolute().parent.parent):
            sync_folder(folder)
        return os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)

    def _describe_loss(self) -> str:
        """Return what has become of the folder, as the kernel knows it."""
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


class FolderContents(NamedTuple):
    """What a folder holds of this run: up to which instant, and how many frames or messages."""

    until_ns: int
    items: int


_UNITS = {TELEMETRY: "messages", FRAMES: "frames"}


class CompanionFile(Protocol):
    """A file of the session with another writer, such as the journal."""

    name: str

    @property
    def lost(self) -> str:
        """Why it is not there any more, "" while it is."""
        ...

    async def recover(self) -> bool:
        """Return whether it is back; else it has been rewritten. OSError when that cannot be done."""
        ...


class FolderWatch:
    """The losses that stand; used from the event loop. `there` is set while the frames' folder is."""

    def __init__(self, directory: Path, tell: Callable[[Event], None]) -> None:
        self._directory = directory
        self._tell = tell
        self._lost: dict[str, str] = {}
        self._kept: dict[str, FolderContents] = {}  # by what was lost
        self._made_again: list[str] = []  # made again by a refounding that has not come to its end
        self._reason = ""
        self.companions: list[CompanionFile] = []
        self.recovery_requested = asyncio.Event()
        self.frames_folder_present = asyncio.Event()
        self.frames_folder_present.set()

    @property
    def lost(self) -> str:
        """The first loss as a sentence; "" when there is none, or while it is being made good."""
        if self.recovery_requested.is_set():
            return ""
        return self._find_first_loss()

    def _find_first_loss(self) -> str:
        return next(
            (reason for reason in (*self._lost.values(), *(each.lost for each in self.companions)) if reason), ""
        )

    def follow(self, name: str, failure: OSError | str | None, kept: FolderContents) -> None:
        """Note how the last look at one folder ended: only a FolderLost, or its sentence, is a loss; None ends it."""
        was = self._find_first_loss()
        if isinstance(failure, FolderLost):
            failure = str(failure.strerror)
        if isinstance(failure, str):
            self._lost[name] = failure
            self._kept.setdefault(name, kept)
        elif failure is None:
            self._lost.pop(name, None)
            self._kept.pop(name, None)
        if FRAMES not in self._lost:
            self.frames_folder_present.set()
        else:
            self.frames_folder_present.clear()
        self._follow_change(was)

    def _follow_change(self, was: str) -> None:
        now = self._find_first_loss()
        if now and not was:
            self._reason = now
            self._tell(FOLDER_LOST.at(0, now, folder=str(self._directory)))
        if was and not now and not self._made_again:
            self._tell(FOLDER_BACK.at(0, folder=str(self._directory)))

    def request_recovery(self) -> None:
        """Ask for `refound`, when there is something to find again."""
        if self._find_first_loss():
            self.recovery_requested.set()

    async def recover(self, telemetry: RecoverFolder, frames: RecoverFolder) -> tuple[str, ...]:
        """Find or make again each part; the names of what had to be made again. When the disk refuses, that is
        reported and the loss stands."""
        parts = [(TELEMETRY, telemetry), (FRAMES, frames), *((each.name, each.recover) for each in self.companions)]
        try:
            for name, refound in parts:
                if not await refound() and name not in self._made_again:
                    self._made_again.append(name)
                self._lost.pop(name, None)
        except OSError as error:
            self._tell(FOLDER_NOT_MADE.at(0, str(error), folder=str(self._directory)))
            return ()
        finally:
            self.recovery_requested.clear()
        self.frames_folder_present.set()
        made_again, self._made_again = tuple(self._made_again), []
        if not made_again:
            self._tell(FOLDER_BACK.at(0, folder=str(self._directory)))
        return made_again

    def make_loss_event(self, made_again: tuple[str, ...], from_ns: int) -> Event:
        """Return what is not in the session's folder any more: all that this run had recorded in what was made
        again."""
        gone = {name: self._kept[name] for name in made_again if name in self._kept}
        self._kept.clear()
        to_ns = max((kept.until_ns for kept in gone.values()), default=from_ns)
        counts = {name: kept.items for name, kept in gone.items()}
        data = {"what": list(made_again), "from_ns": from_ns, "to_ns": to_ns, "counts": counts, "reason": self._reason}
        lost = "".join(f", {counts[name]} {_UNITS[name]}" for name in counts)
        return RECORDING_LOST.at(0, lost, **data)
