"""A fault that nobody has cleared, on this computer's disk: it belongs to the stand, not to a process or a recording.

Two files for each address of what heats and cools, so that it is found again whatever the folder of the sessions, the
configuration's name or the program that asks, and when the disk forgets one of them. They are on the disk before
anything is said of the fault. A file that cannot be read counts as a fault: nobody knows what it held.
"""

from __future__ import annotations

import os
import stat
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import replace_file, sync_folder
from thermostand.foundation.sealed import seal, unseal
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.fault import Fault
from thermostand.stand.running.opening.claim import addresses, file_name

SYSTEM_FOLDER = Path("/var/lib/thermostand")
UNREADABLE = "latch_unreadable"
_KIND = "latch"
_ENDS = (".latched.json", ".again.latched.json")  # each synced by itself: what is lost at once is one of them
_HEATING = ("bus", "regulator")  # of the addresses: two stands that share a camera are two stands
_LONGEST_BYTES = 1_000_000
WITHIN_S = 0.25
"""How long the guard's loop waits for the disk before it makes safe: a written and synced file takes 1 to 20 ms on a
disk that works, and one that hangs must not keep the heat on."""


class LatchedFault(BaseModel):
    """The file's content. since_ns: the host's clock."""

    model_config = ConfigDict(frozen=True, strict=True)

    rule: str
    text: str
    since_ns: int


class StandLatch:
    """Of one stand. Blocking, but for `keep` and `forget`, which wait for WITHIN_S at most."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._paths = tuple(paths)
        self._turn = threading.Lock()
        self.run: Callable[..., object] = _here
        """Calls a function with its arguments where a disk may hang."""

    @classmethod
    def of(cls, config: StandConfig) -> StandLatch:
        """Of the stand of a configuration; asks the name service, as `addresses`."""
        folder = state_folder()
        places = sorted({each.place for each in addresses(config) if each.device in _HEATING})
        return cls(folder / file_name(place.partition(" in net:")[0], end) for end in _ENDS for place in places)

    def read(self) -> LatchedFault | None:
        """The fault that nobody has cleared; None when there is none."""
        for path in self._paths:
            try:
                found = path.lstat()
            except FileNotFoundError:
                continue
            except OSError as error:
                return _unreadable(path, error.strerror)
            if not stat.S_ISREG(found.st_mode):
                return _unreadable(path, "it is no file")
            if found.st_size > _LONGEST_BYTES:
                return _unreadable(path, "it is too long")
            try:
                return LatchedFault.model_validate_json(unseal(_KIND, path.read_bytes()))
            except OSError as error:
                return _unreadable(path, error.strerror)
            except ValueError:
                return _unreadable(path, "it is damaged")
        return None

    def keep(self, fault: Fault, since_ns: int) -> str:
        """Write it; "" when it is on the disk, else why it is not known to be."""
        text = LatchedFault(rule=fault.rule, text=fault.text, since_ns=since_ns).model_dump_json(indent=1)
        return self._bounded(_write, seal(_KIND, text))

    def forget(self) -> str:
        """An operator has cleared it; as `keep`."""
        return self._bounded(_remove)

    def clear(self) -> None:
        """As `forget`, however long it takes; SessionError when a file cannot be removed: the stand stays latched."""
        try:
            _remove(self._paths)
        except OSError as error:
            raise SessionError(
                f"{error.filename}: cannot be removed ({error.strerror}), so the stand stays latched; remove it by hand"
            ) from error

    def _bounded(self, function: Callable[..., object], *arguments: object) -> str:
        failure: list[str] = []

        def work() -> None:
            with self._turn:
                try:
                    try:
                        self.run(function, self._paths, *arguments)
                    except BrokenPipeError:  # the process that touches the disk has ended
                        function(self._paths, *arguments)
                except Exception as error:  # noqa: BLE001 - whatever it is, it is said
                    failure.append(str(error))

        thread = threading.Thread(target=work, name="stand-latch", daemon=True)
        thread.start()
        thread.join(WITHIN_S)
        return "the disk has not answered" if thread.is_alive() else "".join(failure)


def state_folder() -> Path:
    """`/var/lib/thermostand` where `stand service install` has made it, for every operator's program; else
    `$XDG_STATE_HOME/thermostand`, by default below `~/.local/state`."""
    if SYSTEM_FOLDER.is_dir():
        return SYSTEM_FOLDER
    given = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (given if given.is_absolute() else Path.home() / ".local" / "state") / "thermostand"


def _here(function: Callable[..., object], *arguments: object) -> object:
    return function(*arguments)


def _write(paths: tuple[Path, ...], data: bytes) -> None:
    for path in paths:
        replace_file(path, data)


def _remove(paths: tuple[Path, ...]) -> None:
    for path in paths:
        try:
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            else:
                path.unlink()
        except FileNotFoundError:
            continue
        with suppress(FileNotFoundError):
            sync_folder(path.parent)


def _unreadable(path: Path, why: str | None) -> LatchedFault:
    text = f"{path} says whether this stand has tripped, and cannot be read ({why}); look at the stand, then clear it"
    return LatchedFault(rule=UNREADABLE, text=text, since_ns=0)
