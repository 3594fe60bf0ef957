"""Which files call each other on the ways through the program: a reading, a frame, a set-point, two aborts.

`python -m tests.bench.ways`, half a minute. A simulated stand runs in real time with a daemon's disk process;
a profile function (sys.setprofile) in the event loop, in the threads of the lanes and in the disk process notes the
stack, through coroutines too, each time one of the functions in `_ENDS` begins. A way is the files on such stacks, one
behind the other as the value passes them; types that only hold values run no code of theirs and do not appear.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from tests.system.simulated_orders import simulated_order
from thermostand.foundation import calls
from thermostand.foundation.items import Item, StepMark, StepState
from thermostand.stand.run import Interrupted, StandTripped, run_real
from thermostand.stand.simulator import ControlSocket, Simulator, laboratory_of

ROOT = Path(__file__).resolve().parents[2]
NOTES = "WAYS_NOTES"  # the environment variable with the file of the notes
RECIPE = """
name: ways
experiments:
  - steps: [start_chamber: 24, set_temperature: 25, open_flap, capture: {frames: 3, interval_s: 2, role: fit}]
  - thermal_cycle: {set_points_degC: [26]}
"""
Stack = tuple[str, ...]
"""`file:function`, from the outermost."""

_WIRE, _ASKED = "modbus_client:_execute", "calls:_submitted"
_ENDS = (
    _WIRE,
    _ASKED,
    "modbus_unit:decode",
    "aravis:pixels",
    "hub:publish",
    "telemetry:receive",
    "frames:receive",
    "telemetry:encode",
    "images:encode_image",
    "calls:send",
    "segment:_write",
    "steps:number_steps",
    "thermal_cycle:thermal_cycle",
    "actions:next_action",
    "safety:demand",
    "interlocks:check",
)


@dataclass(frozen=True)
class Part:
    """The stack at the beginning of `end` that has all of `through`, from the first of them on (files or
    functions); `back`: the value goes outwards on it."""

    end: str
    through: tuple[str, ...]
    back: bool = False


_READ_BY_REGULATOR = ("poller", "regulator")
_ONTO_DISK = (Part("segment:_write", ("calls", "series")),)
_SAFE = (Part(_ASKED, ("safety", "regulator")), Part(_WIRE, ("calls",)))
WAYS: dict[str, tuple[Part, ...]] = {
    "set-point": (
        Part("thermal_cycle:thermal_cycle", ("recipe",)),
        Part("steps:number_steps", ("steps",)),
        Part("actions:next_action", ("executor",), back=True),
        Part(_ASKED, ("executor", "chamber", "regulator")),
        Part(_WIRE, ("calls",)),
    ),
    "abort, signal": (Part("safety:demand", ("stop",)), *_SAFE),
    "abort, rule": (
        Part("interlocks:check", ("guard",), back=True),
        Part("safety:demand", ("guard", "_make_safe")),
        *_SAFE,
    ),
    "reading": (
        Part(_WIRE, ("calls",), back=True),
        Part(_ASKED, _READ_BY_REGULATOR, back=True),
        Part("modbus_unit:decode", _READ_BY_REGULATOR, back=True),
        Part("telemetry:receive", ("poller", "hub")),
        Part("telemetry:encode", ("calls",)),
        Part("calls:send", ("calls", "telemetry")),
        *_ONTO_DISK,
    ),
    "frame": (
        Part("aravis:pixels", ("calls", "camera_connection"), back=True),
        Part(_ASKED, ("imaging", "camera_gige"), back=True),
        Part("frames:receive", ("imaging", "hub")),
        Part("images:encode_image", ("calls",)),
        Part("calls:send", ("calls", "frames")),
        *_ONTO_DISK,
    ),
}


class Tracer:
    """The profile function of each thread; each stack is noted once, a line in the file."""

    def __init__(self, notes: Path) -> None:
        self._notes = notes
        self._seen: set[Stack] = set()
        self._names: dict[object, str] = {}

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call" and self._name(frame) in _ENDS:
            stack = self._stack(frame)
            if stack not in self._seen:
                self._seen.add(stack)
                with self._notes.open("a") as notes:
                    notes.write(" ".join(stack) + "\n")

    def _name(self, frame: FrameType) -> str:
        """Of a function of the product; "" of others."""
        code = frame.f_code
        name = self._names.get(code)
        if name is None:
            path = Path(code.co_filename)
            is_ours = path.is_relative_to(ROOT) and not path.is_relative_to(ROOT / "tests")
            is_ours = is_ours and ".venv" not in path.parts
            name = self._names[code] = f"{path.stem}:{code.co_name}" if is_ours else ""
        return name

    def _stack(self, frame: FrameType | None) -> Stack:
        names: list[str] = []
        while frame is not None:
            names.append(self._name(frame))
            frame = frame.f_back
        return tuple(name for name in reversed(names) if name)

    def install(self) -> None:
        """For this thread, and those that are begun from now on."""
        threading.setprofile(self)
        sys.setprofile(self)
        serve = calls._serve  # pyright: ignore[reportPrivateUsage] - its thread is not one of threading

        def traced(*args: object) -> None:
            sys.setprofile(self)
            serve(*args)  # pyright: ignore[reportArgumentType]

        calls._serve = traced  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]


def trace_here() -> None:
    """For the disk process, before it does anything: see `_in_children`."""
    Tracer(Path(os.environ[NOTES])).install()


def _in_children(directory: Path) -> None:
    """Each helper process begins to trace by itself."""
    text = (
        "import sys\nif 'thermostand.recording.writing.disk' in sys.orig_argv:\n"
        "    from tests.bench.ways import trace_here\n    trace_here()\n"
    )
    (directory / "sitecustomize.py").write_text(text)
    os.environ["PYTHONPATH"] = f"{directory}:{ROOT}"


async def _run(directory: Path, trip: bool) -> None:
    """Until the frames are taken, then ended by the operator or by the guard."""
    order = simulated_order(directory, RECIPE)
    simulator = await asyncio.to_thread(Simulator, laboratory_of(order.config, virtual=False, seed=None))
    control = ControlSocket(simulator.addresses["control"])
    ending: list[asyncio.Task[object]] = []

    async def end() -> None:
        await asyncio.sleep(2.5)  # a poll and a commit later
        if trip:
            await control.request({"do": "fault", "name": "camera.sensor_degC", "value": 95.0})
        else:
            os.kill(os.getpid(), signal.SIGINT)

    def receive(item: Item) -> None:
        is_captured = isinstance(item, StepMark) and item.kind == "capture" and item.state is StepState.DONE
        if is_captured and not ending:
            ending.append(asyncio.ensure_future(end()))

    try:
        await control.open()
        await run_real(order, directory, lambda hub: hub.subscribe(receive))
    finally:
        await control.close()
        await asyncio.to_thread(simulator.stop)


def stacks() -> list[Stack]:
    """Every stack of two runs, one ended by Ctrl-C and one by the guard."""
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder)
        notes = directory / "notes"
        os.environ[NOTES] = str(notes)
        _in_children(directory)
        Tracer(notes).install()
        for name, error in (("signal", Interrupted), ("rule", StandTripped)):
            place = directory / name
            place.mkdir()
            with suppress(error):
                asyncio.run(_run(place, name == "rule"))
        sys.setprofile(None)
        return [tuple(line.split()) for line in notes.read_text().splitlines()]


def way(parts: Iterable[Part], seen: Sequence[Stack]) -> list[str]:
    """The files of a way in order, each where it is first; LookupError when a part of it was not seen."""
    files: list[str] = []
    for part in parts:
        found = [name.partition(":")[0] for name in _stack_of(part, seen)]
        files += reversed(found) if part.back else found
    return list(dict.fromkeys(files))


def _stack_of(part: Part, seen: Sequence[Stack]) -> Stack:
    for stack in seen:
        words = [word for name in stack for word in name.split(":")]
        if stack[-1] == part.end and all(word in words for word in part.through):
            return stack[words.index(part.through[0]) // 2 :]
    raise LookupError(f"nothing has come to {part.end} through {', '.join(part.through)}")


def main() -> None:
    """Print each way as a row of docs/stand.md."""
    seen = stacks()
    for name, parts in WAYS.items():
        files = way(parts, seen)
        sys.stdout.write(f"| {name} | {len(files)} | {', '.join(files)} |\n")


if __name__ == "__main__":
    main()
