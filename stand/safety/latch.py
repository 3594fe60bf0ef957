"""Whether the stand has tripped: one latch, which interlock, run, page, status and SECoP ask, and a restart finds.

It belongs to the stand, not to a process or a recording. What only an operator ends is on this computer's disk before
anything is reported: two files for each address of what heats and cools, found whatever the folder of the sessions,
the configuration's name or the program that asks, and when the disk forgets one of them. A file that cannot be read
counts as a fault: nobody knows what it held.
"""

from __future__ import annotations

import asyncio
import os
import stat
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import LATCH_NOT_KEPT, LATCH_NOT_RESET
from thermostand.foundation.files import replace_file, sync_folder
from thermostand.foundation.hub import Hub
from thermostand.foundation.sealed import seal, unseal
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import INTERLOCK, Gate

SYSTEM_FOLDER = Path("/var/lib/thermostand")
UNREADABLE = "latch_unreadable"
_KIND = "latch"
_ENDS = (".latched.json", ".again.latched.json")  # each synced by itself: what is lost at once is one of them
_READ_WITHIN_S = 5.0  # before anything is opened: a disk that has slept needs some seconds, nobody waits for them
_LONGEST_BYTES = 1_000_000  # a latch has some hundred
# Reporting first and writing meanwhile forgot 3 of 7 trips whose process was killed at that moment.
WITHIN_S = 0.25
"""How long the guard's loop waits for the disk before it makes safe: a written and synced file takes 1 to 20 ms on a
disk that works, and one that hangs must not keep the heat on."""


class LatchedFault(BaseModel):
    """The file's content. since_ns: the host's clock."""

    model_config = ConfigDict(frozen=True, strict=True)

    rule: str
    text: str
    since_ns: int


class Latch:
    """The latch of one stand. fault: what it was made safe for and nobody has reset, None when nothing is. since_ns:
    when that was found. file: what outlives this process; None in virtual time."""

    def __init__(self, gate: Gate, hub: Hub, clock: Clock) -> None:
        self.fault: Fault | None = None
        self.since_ns = 0
        self.file: LatchFile | None = None
        self._gate = gate
        self._hub = hub
        self._clock = clock

    def trip(self, fault: Fault) -> None:
        """Latch the trip, on the disk first, but for what ends by itself; waits for WITHIN_S at most. A fault that
        stays is since when it was found first."""
        now_ns = self._clock.now_ns()
        since_ns = now_ns if self.fault is None or self.fault.rule != fault.rule else self.since_ns
        failure = "" if self.file is None or fault.ends_itself else self.file.keep(fault, since_ns)
        self.fault, self.since_ns = fault, since_ns
        if failure:
            self._hub.publish(LATCH_NOT_KEPT.at(now_ns, failure))

    def hold_gate(self) -> None:
        """Hold the gate by what has tripped, if anything has."""
        if self.fault is not None:
            self._gate.hold(INTERLOCK)

    async def restore(self) -> None:
        """Hold the gate by what a program before this one has left, and nobody has reset. May wait for a disk."""
        found = None if self.file is None else await asyncio.to_thread(self.file.read)
        if found is not None:
            self.fault, self.since_ns = Fault(found.rule, found.text, "hold"), found.since_ns
            self.hold_gate()

    def reset(self) -> None:
        """Forget the trip and release the gate; the disk is waited for as by `trip`."""
        self.fault = None
        self._gate.clear(INTERLOCK)
        if self.file is not None and (failure := self.file.remove()):
            self._hub.publish(LATCH_NOT_RESET.at(self._clock.now_ns(), failure))


class LatchFile:
    """The latch of one stand on the disk. Blocking, but for `keep` and `forget`, which wait for WITHIN_S at most."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._paths = tuple(paths)
        self._turn = threading.Lock()
        self.run: Callable[..., object] = _call_directly
        """Calls a function with its arguments where a disk may hang."""

    @classmethod
    def for_addresses(cls, names: Iterable[str]) -> LatchFile:
        """The files in this computer's folder, by the names of the addresses of what heats and cools."""
        folder, names = find_state_folder(), tuple(names)
        return cls(folder / f"{name}{end}" for end in _ENDS for name in names)

    def read(self) -> LatchedFault | None:
        """The fault that nobody has reset; None when there is none."""
        found: list[LatchedFault | None] = []
        reading = threading.Thread(
            target=lambda: found.append(_read_latch(self._paths)), name="stand-latch", daemon=True
        )
        reading.start()
        reading.join(_READ_WITHIN_S)
        return found[0] if found else _make_unreadable_fault(self._paths[0], "the disk has not answered")

    def keep(self, fault: Fault, since_ns: int) -> str:
        """Write it; "" when it is on the disk, else why it is not known to be."""
        text = LatchedFault(rule=fault.rule, text=fault.text, since_ns=since_ns).model_dump_json(indent=1)
        return self._run_within_limit(_write, seal(_KIND, text))

    def remove(self) -> str:
        """An operator has reset it; as `keep`."""
        return self._run_within_limit(_remove)

    def reset(self) -> None:
        """Forget the trip as `forget` does, however long it takes; SessionError when a file cannot be removed: the
        stand stays latched."""
        try:
            _remove(self._paths)
        except OSError as error:
            raise SessionError(
                f"{error.filename}: cannot be removed ({error.strerror}), so the stand stays latched; remove it by hand"
            ) from error

    def _run_within_limit(self, function: Callable[..., object], *arguments: object) -> str:
        failure: list[str] = []

        def work() -> None:
            with self._turn:
                try:
                    try:
                        self.run(function, self._paths, *arguments)
                    except BrokenPipeError:  # the process that touches the disk has ended
                        function(self._paths, *arguments)
                except Exception as error:  # noqa: BLE001 - whatever it is, it is reported
                    failure.append(str(error))

        thread = threading.Thread(target=work, name="stand-latch", daemon=True)
        thread.start()
        thread.join(WITHIN_S)
        return "the disk has not answered" if thread.is_alive() else "".join(failure)


def find_state_folder() -> Path:
    """`/var/lib/thermostand` where `stand service install` has made it, for every operator's program; else
    `$XDG_STATE_HOME/thermostand`, by default below `~/.local/state`."""
    if SYSTEM_FOLDER.is_dir():
        return SYSTEM_FOLDER
    given = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (given if given.is_absolute() else Path.home() / ".local" / "state") / "thermostand"


def _call_directly(function: Callable[..., object], *arguments: object) -> object:
    return function(*arguments)


def _read_latch(paths: tuple[Path, ...]) -> LatchedFault | None:
    for path in paths:
        try:
            found = path.lstat()
        except FileNotFoundError:
            continue
        except OSError as error:
            return _make_unreadable_fault(path, error.strerror)
        if not stat.S_ISREG(found.st_mode):
            return _make_unreadable_fault(path, "it is no file")
        if found.st_size > _LONGEST_BYTES:
            return _make_unreadable_fault(path, "it is too long")
        try:
            return LatchedFault.model_validate_json(unseal(_KIND, path.read_bytes()))
        except OSError as error:
            return _make_unreadable_fault(path, error.strerror)
        except ValueError:
            return _make_unreadable_fault(path, "it is damaged")
    # A fault whose file was not renamed was not reported yet; but it was found.
    begun = next((each for path in paths for each in _find_partial_files(path)), None)
    return None if begun is None else _make_unreadable_fault(begun, "the program that wrote it was killed")


def _find_partial_files(path: Path) -> Iterator[Path]:
    """Find what a program that was killed in `replace_file` has left next to it."""
    return path.parent.glob(f".{path.name}.*.part")


def _write(paths: tuple[Path, ...], data: bytes) -> None:
    for path in paths:
        replace_file(path, data)


def _remove(paths: tuple[Path, ...]) -> None:
    for path in chain(paths, *map(_find_partial_files, paths)):
        try:
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            else:
                path.unlink()
        except FileNotFoundError:
            continue
        with suppress(FileNotFoundError):
            sync_folder(path.parent)


def _make_unreadable_fault(path: Path, why: str | None) -> LatchedFault:
    text = f"{path} says whether this stand has tripped, and cannot be read ({why}); look at the stand, then reset it"
    return LatchedFault(rule=UNREADABLE, text=text, since_ns=0)
