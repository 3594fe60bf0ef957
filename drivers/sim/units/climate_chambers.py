"""Commercial climate chambers, each on its wire, with the plant behind it: ESPEC P300, CTS, Weiss/Voetsch (ASCII-2).

Sources: ESPEC P300/SCP-220 and CTS interface manuals, Voetsch ASCII-2 transcripts. Each answers text; how it is framed
is said at its class. The control is proportional over 3 K. None has a watchdog of its communications.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from thermostand.drivers.sim.fakes import CONTROL, Bench, fake
from thermostand.drivers.sim.units.modbus import Timeline
from thermostand.foundation.clock import NS_PER_S, Now

PROPORTIONAL_BAND_K = 3.0


class Chamber(Timeline, Protocol):
    """What a chamber sees and moves of the plant."""

    heater_on_fraction: float
    heater_enabled: bool
    compressor_on: bool
    chamber_degC: float


class FakeClimateChamber:
    """What they share. limits_degC: of the controller. Faults: silent; ignores_writes (local, or an old firmware);
    clamps (a set-point outside the limits is taken as far as they go, and acknowledged); alarm (its code; "" none);
    humidity_on; door_open; protected (the panel refuses remote control); stuck_degC; program_degC (a program of its own
    runs, and goes there). `press_setpoint`, `press_stop`: at the panel. is_alone: no relay in series enables its heat.
    """

    def __init__(self, plant: Chamber, clock: Now) -> None:
        self.setpoint_degC = 23.0
        self.limits_degC = (-40.0, 150.0)
        self.running = False
        self.silent = False
        self.ignores_writes = False
        self.clamps = False
        self.alarm = ""
        self.humidity_on = self.door_open = False
        self.protected = False
        self.stuck_degC: float | None = None
        self.program_degC: float | None = None
        self.setpoint_writes = 0
        self.is_alone = True
        self._plant = plant
        self._clock = clock
        self._stops_ns: int | None = None
        plant.on_step.append(self._on_step)

    def engine(self) -> Conversation:
        """A new conversation with it."""
        raise NotImplementedError

    def press_setpoint(self, setpoint_degC: float) -> None:
        """Somebody changes it at the panel."""
        self.setpoint_degC = setpoint_degC

    def press_stop(self) -> None:
        """Somebody stops it at the panel."""
        self.running = False

    def restart(self, running_at_degC: float | None = None) -> None:
        """A power failure: it comes back stopped, or running at an older set-point."""
        self.running = running_at_degC is not None
        self.setpoint_degC = self.setpoint_degC if running_at_degC is None else running_at_degC

    @property
    def acting_degC(self) -> float:
        """Where it goes, whatever set-point was written."""
        return self.setpoint_degC if self.program_degC is None else self.program_degC

    @property
    def actual_degC(self) -> float:
        """What it shows."""
        return self._plant.chamber_degC if self.stuck_degC is None else self.stuck_degC

    @contextmanager
    def now(self) -> Generator[None]:
        """Its state at the clock's present time."""
        with self._plant.lock:
            self._plant.advance(self._clock.now_ns())
            yield

    def set(self, degC: float) -> bool:
        """A set-point from the wire; whether it is taken."""
        low_degC, high_degC = self.limits_degC
        if not low_degC <= degC <= high_degC and not self.clamps:
            return False
        if not self.ignores_writes:
            self.setpoint_degC = min(high_degC, max(low_degC, degC))
            self.setpoint_writes += 1
        return True

    def switch(self, on: bool) -> None:
        """Start or stop from the wire; a stop ends a program, too."""
        if not self.ignores_writes:
            self.running = on
            self.program_degC = self.program_degC if on else None

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        if self._stops_ns is not None and time_ns >= self._stops_ns:
            self.running, self._stops_ns = False, None
        share = (self.acting_degC - self.actual_degC) / PROPORTIONAL_BAND_K if self.running and not self.alarm else 0.0
        if self.is_alone:
            self._plant.heater_enabled = True
        self._plant.heater_on_fraction = min(1.0, max(0.0, share))
        self._plant.compressor_on = share < -0.1


class Conversation:
    """Bytes in, bytes out; `take(buffer) -> (reply, rest)` or None while a request is not whole."""

    def __init__(self, chamber: FakeClimateChamber, take: Callable[[bytes], tuple[bytes, bytes] | None]) -> None:
        self._chamber = chamber
        self._take = take
        self._buffer = b""

    def feed(self, data: bytes) -> bytes:
        """Answer every request that is whole."""
        self._buffer += data
        replies = b""
        with self._chamber.now():
            while (taken := self._take(self._buffer)) is not None:
                reply, self._buffer = taken
                replies += reply
        return b"" if self._chamber.silent else replies


class FakeEspec(FakeClimateChamber):
    """P300: commands and replies are lines, CR LF; `NA:` and a reason when refused. mode: what it says instead of its
    own."""

    mode = ""

    def engine(self) -> Conversation:
        """Lines."""

        def take(buffer: bytes) -> tuple[bytes, bytes] | None:
            line, separator, rest = buffer.partition(b"\n")
            if not separator:
                return None
            return self._answer(line.decode("latin-1").strip()).encode("latin-1") + b"\r\n", rest

        return Conversation(self, take)

    def _answer(self, command: str) -> str:
        low_degC, high_degC = self.limits_degC
        alarms, mode = [self.alarm] if self.alarm else [], "CONSTANT" if self.running else "STANDBY"
        mode = mode if self.program_degC is None else "RUN"
        queries = {
            "TEMP?": f"{self.actual_degC:.1f},{self.acting_degC:.1f},{high_degC:.1f},{low_degC:.1f}",
            "MON?": f"{self.actual_degC:.1f},50,{self.mode or mode},{len(alarms)}",
            "HUMI?": f"48,{'50' if self.humidity_on else 'OFF'},100,0",
            "MODE?": mode,
            "ALARM?": ",".join([str(len(alarms)), *alarms]),
            "TYPE?": "T,T,S2,160.0",
        }
        if command in queries:
            return queries[command]
        if self.protected:
            return "NA:PROTECT ON"
        return self._order(command)

    def _order(self, command: str) -> str:
        if found := re.fullmatch(r"TEMP, ?S(-?\d+\.\d)", command):
            return f"OK:{command}" if self.set(float(found[1])) else "NA:DATA OUT OF RANGE"
        if found := re.fullmatch(r"TIMER WRITE,NO0,(\d+):(\d\d),STANDBY", command):
            self._timer_s = 3600 * int(found[1]) + 60 * int(found[2])
            return f"OK:{command}"
        match command:
            case "MODE,CONSTANT":
                self.switch(True)
            case "MODE,STANDBY" | "MODE,OFF":
                self.switch(False)
            case "HUMI,SOFF":
                self.humidity_on = False
            case "TIMER,ON,0":
                self._stops_ns = self._clock.now_ns() + self._timer_s * NS_PER_S
            case _:
                return "NA:CMD ERR"
        return f"OK:{command}"

    _timer_s = 0


class FakeCts(FakeClimateChamber):
    """CTS unit `unit`. On a serial line STX, 80+unit, text, CHK, ETX with bit 7 set between STX and ETX and CHK the XOR
    of address and text; over TCP the bare text without an end. An unknown command is not answered. paused: at its
    panel. ramps: one of its own runs."""

    paused = ramps = False

    def __init__(self, plant: Chamber, clock: Now, unit: int = 1, *, is_serial: bool = False) -> None:
        super().__init__(plant, clock)
        self.unit = unit
        self.answers_as = unit
        self._is_serial = is_serial

    def engine(self) -> Conversation:
        """Frames, or bare texts."""
        return Conversation(self, self._take_frame if self._is_serial else self._take_text)

    def _take_text(self, buffer: bytes) -> tuple[bytes, bytes] | None:
        found = re.match(rb"a0 -?\d+\.\d|s[123] [01]|[A-Z][0-9:;<]?", buffer)
        if found is None:
            return None if len(buffer) < 9 else (b"", b"")
        return self._answer(found[0].decode()).encode("latin-1"), buffer[found.end() :]

    def _take_frame(self, buffer: bytes) -> tuple[bytes, bytes] | None:
        begin, end = buffer.find(b"\x02"), buffer.find(b"\x03")
        if begin < 0 or end < begin:
            return None
        body, rest = buffer[begin + 1 : end], buffer[end + 1 :]
        text = bytes(byte & 0x7F for byte in body[1:-1])
        check = 0
        for byte in body[:-1]:
            check ^= byte
        if body[0] != 0x80 + self.unit or body[-1] != check | 0x80:
            return b"", rest
        reply = self._answer(text.decode("latin-1"))
        if not reply:
            return b"", rest
        high = bytes([0x80 + self.answers_as, *(ord(character) | 0x80 for character in reply)])
        check = 0
        for byte in high:
            check ^= byte
        return b"\x02" + high + bytes([check | 0x80]) + b"\x03", rest

    def _answer(self, command: str) -> str:
        match command[:2]:
            case "A0":
                return f"A0 {self.actual_degC:05.1f} {self.acting_degC:05.1f}"
            case "P":
                return f"P{0 if self.program_degC is None else 2:03d}"
            case "R1":
                return f"R1 1{int(self.ramps)} 001.0 001.0 {self.setpoint_degC:05.1f}"
            case "a0":
                self.set(float(command[3:]))
                return "a"
            case "s1":
                self.switch(command[3] == "1")
                return "s1"
            case "S":
                flags = (self.running, bool(self.alarm), not self.paused, self.humidity_on, False, False, False, False)
                code = chr(int(self.alarm, 16)) if self.alarm else "0"
                return "S" + "".join(str(int(flag)) for flag in flags) + code
            case "O":
                closed = chr(0x30 | (0 if self.door_open else 4))
                return f"O{int(self.running)}{int(bool(self.alarm))}0{closed}0000"
            case "F":
                text = f"error {self.alarm}" if self.alarm else ""
                return f"F{text:<32}"
            case _:
                return ""


class FakeWeiss(FakeClimateChamber):
    """ASCII-2, unit `unit`: seven pairs of nominal and actual, 32 digits; DO01 starts, DO02 is humidity. E is answered
    by 0, or by nothing when it is `mute`; one that is ignored is answered in the same way. ramp_K_per_min: the nominal
    value in the reply moves."""

    def __init__(self, plant: Chamber, clock: Now, unit: int = 1) -> None:
        super().__init__(plant, clock)
        self.unit = unit
        self.mute = False
        self.ramp_K_per_min: float | None = None
        self._fan_percent = 90.0
        self._shown_degC = self.setpoint_degC

    def engine(self) -> Conversation:
        """Lines that end with CR."""

        def take(buffer: bytes) -> tuple[bytes, bytes] | None:
            line, separator, rest = buffer.partition(b"\r")
            return (self._answer(line.decode("latin-1").strip()), rest) if separator else None

        return Conversation(self, take)

    def _nominal_degC(self) -> float:
        return self.acting_degC if self.ramp_K_per_min is None else self._shown_degC

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        super()._on_step(time_ns, dt_s)
        if self.ramp_K_per_min is not None:
            step_K = self.ramp_K_per_min * dt_s / 60
            self._shown_degC += max(-step_K, min(step_K, self.setpoint_degC - self._shown_degC))

    def _answer(self, line: str) -> bytes:
        if not line.startswith(f"${self.unit:02d}"):
            return b""
        command, *fields = line[3:].split()
        if command == "I":
            return self._state().encode() + b"\r"
        if command != "E" or len(fields) != 8:
            return b""
        if self.set(float(fields[0])) and not self.ignores_writes:
            self._fan_percent = float(fields[2])
            self.switch(fields[-1][1] == "1")
            self.humidity_on = fields[-1][2] == "1"
        return b"" if self.mute else b"0\r"

    def _state(self) -> str:
        pairs = [
            (self._nominal_degC(), self.actual_degC),
            (80.0, 66.7),
            (self._fan_percent, self._fan_percent),
            *((0.0, value) for value in (23.8, 22.2, 25.5, 24.4)),
        ]
        digits = f"0{int(self.running)}{int(self.humidity_on)}" + 29 * "0"
        return " ".join([*(f"{value:06.1f}" for pair in pairs for value in pair), digits])


Made = TypeVar("Made", bound=FakeClimateChamber)


def built(bench: Bench, name: str, settings: Mapping[str, Any], chamber: Made) -> Made:
    """At its address; its controller allows the set-points that it should."""
    chamber.is_alone = not bench.has_relays
    low_degC, high_degC = settings["limits_degC"]
    chamber.limits_degC = low_degC, high_degC
    bench.listen(name, settings["address"], chamber.engine)
    return chamber


@fake("climate_chamber.espec", rank=CONTROL)
def _build_espec(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeEspec:
    return built(bench, name, settings, FakeEspec(bench.plant, bench.clock))


@fake("climate_chamber.cts", rank=CONTROL)
def _build_cts(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeCts:
    is_serial = settings["address"].startswith("serial:")
    return built(bench, name, settings, FakeCts(bench.plant, bench.clock, settings["unit"], is_serial=is_serial))


@fake("climate_chamber.ascii2", rank=CONTROL)
def _build_ascii2(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeWeiss:
    return built(bench, name, settings, FakeWeiss(bench.plant, bench.clock, settings["unit"]))
