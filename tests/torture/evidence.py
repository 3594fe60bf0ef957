"""What an observer from outside has of a case: the plant's truth, the bytes on the wires, the disk, what HTTP said, and
how each life ended. Nothing of the guard, the recorder or the reader gets it: MCAP files are read by the mcap package.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tests import fork_server
from tests.torture.case import Case
from tests.torture.laboratory import TRUTH
from tests.torture.lives import COMPLETE, KILLED, ROOT, Life
from tests.torture.real import KINDS as REAL
from thermostand.foundation.clock import to_ns

ROW = np.dtype([("time_ns", "<i8"), *((name, "<f8") for name in TRUTH)])
CENTRES = np.dtype([("time_ns", "<i8"), ("xy_px", "<f8", (54, 2))])

STEP_S = 0.5  # of the plant: what is switched or broken within a step acts from its begin on
LATE_S = 3.0  # what is done in real time is done so much later at worst, on a busy machine
GIVEN_UP = "segment_given_up"
"""The event of a file that a disk has refused: it stays unfinished, and is salvaged when the run has ended."""


@dataclass(frozen=True, slots=True)
class RecordedEvent:
    """An event of the recording."""

    time_ns: int
    level: str
    kind: str
    text: str
    data: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Mark:
    """A step of the plan as the recording has it."""

    time_ns: int
    step_id: str
    kind: str
    state: str
    parameters: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Exchange:
    """A Modbus request on the bus, and whether a whole answer to it left the unit."""

    time_ns: int
    unit: int
    function: int
    address: int
    value: int
    is_answered: bool


@dataclass
class Evidence:
    """frames: how often each (topic, instant) is there. metas: (instant, step id, flags) of the descriptions.
    temperatures: (instant, degC, quality) by the thermometer's name. Instants are ns. batch_ns: by how much the instant
    of what was read together may be later than that of one reading."""

    batch_ns = 0

    case: Case
    folder: Path
    lives: Sequence[Life]
    unreadable: list[str] = field(default_factory=list)
    events: list[RecordedEvent] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    frames: Counter[tuple[str, int]] = field(default_factory=Counter)
    metas: list[tuple[int, str, str]] = field(default_factory=list)
    temperatures: dict[str, list[tuple[int, float, str]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.stand = yaml.safe_load((self.folder / "stand.yaml").read_text())
        self.session = next(iter(sorted((self.folder / "out").glob("*/journal.jsonl"))), self.folder / "none/x").parent
        self._read_all()
        if self.is_complete and any(event.kind == GIVEN_UP for event in self.events):
            for found in (self.unreadable, self.events, self.marks, self.frames, self.metas, self.temperatures):
                found.clear()
            for session in self.sessions:
                program = [sys.executable, "-m", "thermostand.stand.cli", "session", "repair", str(session)]
                fork_server.run(program, cwd=ROOT, capture_output=True)
            self._read_all()

    def _read_all(self) -> None:
        for path in sorted(path for session in self.sessions for path in session.glob("*/*.mcap*")):
            if path.suffix in (".mcap", ".part"):
                self._read(path)

    @property
    def sessions(self) -> list[Path]:
        """All that the program has recorded."""
        return [self.session]

    def at_s(self, time_ns: int) -> float:
        """An instant in s since the case's begin."""
        return round((time_ns - self.case.start_ns) / 1e9, 2)

    @cached_property
    def truth(self) -> list[np.ndarray]:
        """The plant at each of its steps, one array a life."""
        paths = [self.folder / f"truth-{number}.bin" for number in range(len(self.lives))]
        found = [path.read_bytes() if path.exists() else b"" for path in paths]
        return [np.frombuffer(data[: len(data) // ROW.itemsize * ROW.itemsize], ROW) for data in found]

    @cached_property
    def centres(self) -> dict[int, np.ndarray]:
        """Where the target's centres (54, 2) truly were in the image of an instant, px."""
        data = b"".join(path.read_bytes() for path in sorted(self.folder.glob("centres-*.bin")))
        rows = np.frombuffer(data[: len(data) // CENTRES.itemsize * CENTRES.itemsize], CENTRES)
        return dict(zip(rows["time_ns"].tolist(), rows["xy_px"], strict=True))

    def true_at(self, time_ns: int) -> np.void | None:
        """The plant at an instant: that of the last life begun by then, as each has a laboratory of its own."""
        for truth in reversed(self.truth):
            if len(truth) and truth["time_ns"][0] <= time_ns:
                place = int(np.searchsorted(truth["time_ns"], time_ns, side="right")) - 1
                return truth[place] if time_ns <= truth["time_ns"][-1] + int(1e9) else None
        return None

    @cached_property
    def bus(self) -> list[list[Exchange]]:
        """What was reported on the bus, one list a life."""
        return [list(self._bus(number)) for number in range(len(self.lives))]

    @cached_property
    def doors(self) -> list[list[dict[str, Any]]]:
        """What people did and were answered, one list a life."""
        paths = [self.folder / f"doors-{number}.jsonl" for number in range(len(self.lives))]
        return [[json.loads(line) for line in path.read_text().splitlines()] if path.exists() else [] for path in paths]

    @cached_property
    def journal(self) -> list[dict[str, Any]]:
        """The entries of the journal: a checksum, a mark and a JSON a line."""
        path, found = self.session / "journal.jsonl", []
        for line in path.read_text(errors="replace").splitlines() if path.exists() else ():
            try:
                found.append(json.loads(line[line.find("{") :]))
            except ValueError:
                continue
        return found

    @property
    def is_complete(self) -> bool:
        """Whether the last life ended with its plan."""
        return bool(self.lives) and self.lives[-1].status == COMPLETE

    @property
    def hold_s(self) -> float:
        """How long a permission of heat lives."""
        return self.stand["guard"].get("heater_hold_s", 15.0)

    @property
    def stale_s(self) -> float:
        """How long a reading is fresh."""
        return self.stand["guard"]["stale_after_s"]

    @property
    def look_s(self) -> float:
        """How far apart the guard's looks are."""
        return self.stand["guard"]["period_s"]

    @property
    def min_off_s(self) -> float:
        """How long the compressor rests."""
        return self.stand.get("compressor", {}).get("min_off_s", 300.0)

    def off_from_ns(self, life: int) -> int:
        """From when on, after that life's end, everything is off: the laboratory goes on for AFTER_S."""
        return int(self.truth[life]["time_ns"][-1] - 60e9)

    @property
    def killed(self) -> int:
        """How many lives were."""
        return sum(life.status == KILLED for life in self.lives)

    def excused(self, at_s: float, *names: str, after_s: float = 0.0) -> bool:
        """Whether a fault whose name begins so stood then, or not after_s before."""
        return any(
            each.at_s - STEP_S <= at_s <= each.at_s + each.for_s + after_s
            for each in self.case.faults
            if each.name.startswith(names)
        )

    def ordered(self, at_s: float, verb: str, within_s: float) -> bool:
        """Whether somebody did that not within_s before."""
        return any(each.verb == verb and -STEP_S <= at_s - each.at_s <= within_s for each in self.case.orders)

    def killed_soon(self, at_s: float, within_s: float) -> bool:
        """Whether the program was killed not within_s after."""
        return any(0 <= kill_s - at_s <= within_s for kill_s in self.case.kills_s)

    def _bus(self, number: int) -> Iterator[Exchange]:
        path = self.folder / f"wire-{number}.jsonl"
        for line in path.read_text().splitlines() if path.exists() else ():
            try:
                time_ns, name, request, reply = json.loads(line)
            except ValueError:  # the last one of a laboratory that was ended
                continue
            asked, answer = bytes.fromhex(request if name == "bus" else ""), bytes.fromhex(reply)
            while len(asked) >= 12:  # Modbus TCP: transaction, protocol, length, unit, function, address, value
                whole = answer[:4] == asked[:4] and answer[6:8] == asked[6:8]
                whole = whole and len(answer) >= int.from_bytes(answer[4:6]) + 6
                address, value = int.from_bytes(asked[8:10]), int.from_bytes(asked[10:12])
                yield Exchange(time_ns, asked[6], asked[7], address, value, whole)
                asked = asked[int.from_bytes(asked[4:6]) + 6 :]

    def _read(self, path: Path) -> None:
        is_of_frames = path.parent.name == "frames"
        try:
            with path.open("rb") as file:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                topics = [channel.topic for channel in reader.get_summary().channels.values()]
                if is_of_frames:
                    images = reader.iter_messages([topic for topic in topics if topic.endswith("/image")])
                    self.frames.update((channel.topic, each.log_time) for _, channel, each in images)
                    topics = [topic for topic in topics if topic.endswith("/meta")]
                for _, channel, message, decoded in reader.iter_decoded_messages(topics):
                    self._take(channel.topic, message.log_time, decoded)
        except (McapError, OSError, ValueError) as error:
            self.unreadable.append(f"{path.parent.name}/{path.name}: {type(error).__name__}")

    def _take(self, topic: str, time_ns: int, message: Any) -> None:
        if topic == "/experiment/event":
            data = json.loads(message.data_json or "{}")
            self.events.append(RecordedEvent(time_ns, message.level, message.kind, message.text, data))
        elif topic == "/experiment/step":
            parameters = json.loads(message.parameters_json or "{}")
            self.marks.append(Mark(time_ns, message.step_id, message.kind, message.state, parameters))
        elif topic.endswith("/meta"):
            self.metas.append((time_ns, message.step_id, message.flags))
        elif topic == "/readings/thermometers":
            for described, value in message.ListFields():
                if described.name.endswith("_degC"):
                    kind = message.DESCRIPTOR.fields_by_name[f"{described.name}_quality"]
                    quality = kind.enum_type.values_by_number[getattr(message, kind.name)].name
                    row = (time_ns, value, quality)
                    self.temperatures.setdefault(described.name.removesuffix("_degC"), []).append(row)
            for remark in message.remarks:
                name = remark.channel.partition(".")[2]
                if remark.unit == "degC" and f"{name}_degC" not in message.DESCRIPTOR.fields_by_name:
                    kind = remark.DESCRIPTOR.fields_by_name["quality"].enum_type.values_by_number[remark.quality]
                    self.temperatures.setdefault(name, []).append((remark.time_ns, remark.value, kind.name))


class RealEvidence(Evidence):
    """Of a case in real time. Instants are those of the daemon that lived then; truth and wires have them, too."""

    batch_ns = int(LATE_S * 1e9)

    @cached_property
    def truth(self) -> list[np.ndarray]:
        """The plant while each daemon lived and before the next one, whichever laboratories that were."""
        paths = sorted(self.folder.glob("truth-*.bin"), key=lambda path: int(path.stem.partition("-")[2]))
        rows = [
            np.frombuffer(data[: len(data) // ROW.itemsize * ROW.itemsize], ROW) for data in map(Path.read_bytes, paths)
        ]
        whole, found = np.concatenate(rows), list[np.ndarray]()
        for begin_ns, end_ns, life in self._spans():
            found.append(whole[(whole["time_ns"] >= begin_ns) & (whole["time_ns"] < end_ns)])
            found[-1]["time_ns"] += life.offset_ns
        return found

    @cached_property
    def bus(self) -> list[list[Exchange]]:
        """As `truth`; what has armed the relay before a daemon began counts, too."""
        count = len(list(self.folder.glob("wire-*.jsonl")))
        whole = [each for number in range(count) for each in self._bus(number)]
        before_ns = to_ns(self.hold_s + 2 * STEP_S)
        return [
            [
                replace(each, time_ns=each.time_ns + life.offset_ns)
                for each in whole
                if begin_ns - before_ns <= each.time_ns < end_ns
            ]
            for begin_ns, end_ns, life in self._spans()
        ]

    @property
    def sessions(self) -> list[Path]:
        """The run's, and the records between runs."""
        return sorted(path.parent for path in self.folder.glob("out/*/telemetry"))

    def at_s(self, time_ns: int) -> float:
        """An instant in s since the case's begin."""
        begun = [life.offset_ns for life in self.lives if life.begun_ns + life.offset_ns <= time_ns]
        return super().at_s(time_ns - (begun or [0])[-1])

    @property
    def is_complete(self) -> bool:
        """Whether the run came to the plan's end, and the last daemon left as asked."""
        ends = [entry["status"] for entry in self.journal if entry["entry"] == "Ended"]
        return ends[-1:] == ["complete"] and self.lives[-1].status == COMPLETE

    @property
    def killed(self) -> int:
        """Daemons, and processes that wrote for them."""
        return super().killed + sum(order.verb == "disk_process_killed" for order in self.case.orders)

    @property
    def look_s(self) -> float:
        """How far apart the guard's looks are, and how late they are on a busy machine."""
        return super().look_s + LATE_S

    def off_from_ns(self, life: int) -> int:
        """From when on, after that life's end, everything is off."""
        ended = self.lives[life]
        return ended.ended_ns + ended.offset_ns + to_ns(self.hold_s + 2 * STEP_S)

    def excused(self, at_s: float, *names: str, after_s: float = 0.0) -> bool:
        """As for virtual time; what is as good as such a fault counts."""
        return super().excused(at_s, *names, after_s=after_s) or any(
            -STEP_S <= at_s - order.at_s <= order.body["for_s"] + LATE_S + after_s
            for order in self.case.orders
            if any(means.startswith(names) for means in REAL[order.verb].means)
        )

    def killed_soon(self, at_s: float, within_s: float) -> bool:
        """As for virtual time; what wrote for the daemon counts, and a run's end, behind which the process that writes
        the record between runs has to start."""
        ends_s = [self.at_s(event.time_ns) for event in self.events if event.kind == "run.end"]
        deaths_s = [order.at_s for order in self.case.orders if order.verb == "disk_process_killed"]
        return super().killed_soon(at_s, within_s) or any(
            0 <= death_s - at_s <= within_s for death_s in (*deaths_s, *(end_s + within_s for end_s in ends_s))
        )

    def _spans(self) -> Iterator[tuple[int, int, Life]]:
        """From when to when each daemon counts, in the laboratory's time: the first from the begin on."""
        begins_ns = [0, *(life.begun_ns for life in self.lives[1:]), sys.maxsize]
        yield from zip(begins_ns, begins_ns[1:], self.lives, strict=False)
