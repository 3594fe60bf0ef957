"""Commercial climate chambers, each on its wire, with the plant behind it: ESPEC P300, CTS, Weiss/Voetsch (ASCII-2 and
SIMSERV), Julabo.

Sources: ESPEC P300/SCP-220 and CTS interface manuals, Voetsch ASCII-2 transcripts. Each answers text; how it is framed
stands at its class. The control is proportional over 3 K. None has a watchdog of its communications.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import reduce
from operator import xor
from typing import Any

from thermostand.drivers.sim.fakes import CONTROL, Bench, fake
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.foundation.clock import NS_PER_S, Now

PROPORTIONAL_BAND_K = 3.0


class FakeClimateChamber:
    """What they share. limits_degC: of the controller. Faults: silent; ignores_writes (local, or an old firmware);
    clamps (a set-point outside the limits is taken as far as they go, and acknowledged); alarm (its code; "" none);
    humidity_on; door_open; protected (the panel refuses remote control); stuck_degC; program_degC (a program of its own
    runs, and goes there). `press_setpoint`, `press_stop`: at the panel. is_alone: no relay in series enables its heat.
    """

    line_end = b"\r"

    def __init__(self, plant: Plant, clock: Now) -> None:
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
        return Conversation(self, self._take)

    def _take(self, buffer: bytes) -> tuple[bytes, bytes] | None:
        """The reply to the first line, and what follows it; None while it is not whole."""
        line, separator, rest = buffer.partition(self.line_end)
        return (self._reply(line), rest) if separator else None

    def _reply(self, line: bytes) -> bytes:
        raise NotImplementedError

    def press_setpoint(self, setpoint_degC: float) -> None:
        """Change the set-point as an operator at the panel does."""
        self.setpoint_degC = setpoint_degC

    def press_stop(self) -> None:
        """Stop it as an operator at the panel does."""
        self.running = False

    def restart(self, running_at_degC: float | None = None) -> None:
        """A power failure: it comes back stopped, or running at an older set-point."""
        self.running = running_at_degC is not None
        self.setpoint_degC = self.setpoint_degC if running_at_degC is None else running_at_degC

    @property
    def acting_degC(self) -> float:
        """Return where it goes, whatever set-point was written."""
        return self.setpoint_degC if self.program_degC is None else self.program_degC

    @property
    def actual_degC(self) -> float:
        """What it shows."""
        return self._plant.chamber_degC if self.stuck_degC is None else self.stuck_degC

    def now(self) -> AbstractContextManager[int]:
        """Compute the chamber's state at the clock's present time."""
        return self._plant.at(self._clock)

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
    line_end = b"\n"

    def _reply(self, line: bytes) -> bytes:
        return self._answer(line.decode("latin-1").strip()).encode("latin-1") + b"\r\n"

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

    def __init__(self, plant: Plant, clock: Now, unit: int = 1, *, is_serial: bool = False) -> None:
        super().__init__(plant, clock)
        self.unit = unit
        self.answers_as = unit
        self._is_serial = is_serial

    def _take(self, buffer: bytes) -> tuple[bytes, bytes] | None:
        return self._take_frame(buffer) if self._is_serial else self._take_text(buffer)

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
        if body[0] != 0x80 + self.unit or body[-1] != reduce(xor, body[:-1], 0) | 0x80:
            return b"", rest
        reply = self._answer(text.decode("latin-1"))
        if not reply:
            return b"", rest
        high = bytes([0x80 + self.answers_as, *(ord(character) | 0x80 for character in reply)])
        return b"\x02" + high + bytes([reduce(xor, high) | 0x80]) + b"\x03", rest

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

    def __init__(self, plant: Plant, clock: Now, unit: int = 1) -> None:
        super().__init__(plant, clock)
        self.unit = unit
        self.mute = False
        self.ramp_K_per_min: float | None = None
        self._fan_percent = 90.0
        self._shown_degC = self.setpoint_degC

    def _nominal_degC(self) -> float:
        return self.acting_degC if self.ramp_K_per_min is None else self._shown_degC

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        super()._on_step(time_ns, dt_s)
        if self.ramp_K_per_min is not None:
            step_K = self.ramp_K_per_min * dt_s / 60
            self._shown_degC += max(-step_K, min(step_K, self.setpoint_degC - self._shown_degC))

    def _reply(self, line: bytes) -> bytes:
        text = line.decode("latin-1").strip()
        if not text.startswith(f"${self.unit:02d}"):
            return b""
        command, *fields = text[3:].split()
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


# A Julabo circulator on its wire, with the plant behind its bath. Source: FL1201 owner's manual, chapter 11 (commands,
# status and error messages); an `out` command is not answered, and is valid in remote control only.


_JULABO_VERSION = "JULABO TEST 1.0 V 1.20"
_JULABO_INVALID = "-08 INVALID COMMAND"
_JULABO_NOT_NOW = "-09 COMMAND NOT ALLOWED IN CURRENT OPERATING MODE"


class FakeJulabo(FakeClimateChamber):
    """remote: whether somebody has chosen remote control at its panel. A message about a command stands until `status`
    was asked once; alarm: the text of one that stands until it is cleared, such as 01 LOW LEVEL ALARM.

    bank: the working temperature that acts, 0 for T1 (which is what sp_00 sets), 1 for T2, 2 for T3. external: a sensor
    outside is controlled. degF: every temperature on its wire is. unknown: queries that this unit does not have, to
    which it says nothing but -08 in its status, or answers it when `answers_unknown`.
    """

    def __init__(self, plant: Plant, clock: Now) -> None:
        super().__init__(plant, clock)
        self.remote = True
        self.bank = 0
        self.others_degC = (60.0, 80.0)  # T2, T3
        self.external = self.degF = False
        self.unknown: tuple[str, ...] = ()
        self.answers_unknown = False
        self._message = ""

    @property
    def acting_degC(self) -> float:
        """Return where the chosen working temperature leads; with a sensor outside the bath it goes further than
        that."""
        chosen_degC = (self.setpoint_degC, *self.others_degC)[self.bank]
        return chosen_degC + 20.0 if self.external else chosen_degC

    def _reply(self, line: bytes) -> bytes:
        reply = self._answer(line.decode("latin-1").strip())
        return reply.encode("ascii") + b"\r\n" if reply else b""

    def _shown(self, degC: float) -> str:
        return f"{degC * 9 / 5 + 32 if self.degF else degC:.2f}"

    def _answer(self, command: str) -> str:
        if command in self.unknown:
            self._message = "" if self.answers_unknown else _JULABO_INVALID
            return _JULABO_INVALID if self.answers_unknown else ""
        match command:
            case "version":
                return _JULABO_VERSION
            case "status":
                return self._status()
            case "in_pv_00":
                return self._shown(self.actual_degC)
            case "in_sp_00":
                return self._shown(self.setpoint_degC)
            case "in_mode_01":
                return str(self.bank)
            case "in_mode_04":
                return str(int(self.external))
            case "in_sp_06":
                return str(int(self.degF))
            case "in_mode_05":
                return str(int(self.running))
            case _:
                self._message = self._order(command)
                return ""

    def _status(self) -> str:
        message, self._message = self._message, ""
        if self.alarm or message:
            return f"-{self.alarm}" if self.alarm else message
        words = f"{'REMOTE' if self.remote else 'MANUAL'} {'START' if self.running else 'STOP'}"
        return f"0{2 * self.remote + self.running} {words}"

    def _order(self, command: str) -> str:
        """The message that it leaves, "" for one that was taken."""
        if not self.remote:
            return _JULABO_NOT_NOW
        if found := re.fullmatch(r"out_sp_00 (-?\d+\.\d{1,2})", command):
            degC = (float(found[1]) - 32) * 5 / 9 if self.degF else float(found[1])
            if self.set(degC):
                return ""
            return "-10 VALUE TOO SMALL" if degC < self.limits_degC[0] else "-11 VALUE TOO LARGE"
        if found := re.fullmatch(r"out_mode_05 ([01])", command):
            self.switch(found[1] == "1")
            return ""
        return _JULABO_INVALID


# A Weiss or Voetsch chamber with SIMSERV on its wire: fields are parted by a byte B6. Source: public transcripts.


_ACCEPTED, _NO_COMMAND, _BAD_PARAMETER, _NO_CHANNEL = "1", "-5", "-6", "-8"


class FakeSimserv(FakeClimateChamber):
    """Control variable 1; digital channel 1 starts, 2 is humidity. An unknown number is answered by -5, a set-point
    outside of the limits by -6. gradient_K_per_min: upwards, 0 for none; None for a unit that does not know them.
    A program goes on when the start channel is cleared, until it is ended (19015)."""

    def __init__(self, plant: Plant, clock: Now, chamber: int = 1) -> None:
        super().__init__(plant, clock)
        self._chamber = str(chamber)
        self.gradient_K_per_min: float | None = 0.0
        self.serial_number = "58226123450010"

    def _reply(self, line: bytes) -> bytes:
        return self._answer(line.lstrip(b"\n").split(b"\xb6")) + b"\r\n"

    def _answer(self, words: list[bytes]) -> bytes:
        command, chamber, *arguments = [word.decode("latin-1") for word in words] + [""] * (2 - len(words))
        if chamber != self._chamber:
            return b"-4"
        reads = {
            ("10010", ()): "2" if self.program_degC is None else "4",
            ("10012", ()): str(1 + 2 * self.running + 8 * bool(self.alarm)),
            ("11002", ("1",)): f"{self.setpoint_degC:.1f}",
            ("11004", ("1",)): f"{self.actual_degC:.2f}",
            ("11007", ("1",)): f"{self.limits_degC[0]:.1f}",
            ("11009", ("1",)): f"{self.limits_degC[1]:.1f}",
            ("14003", ("1",)): str(int(self.running)),
            ("14003", ("2",)): str(int(self.humidity_on)),
            ("99997", ("1",)): "VT3 7034",
            ("99997", ("2",)): "2014",
            ("99997", ("3",)): self.serial_number,
            **self._gradients(),
            **self._messages(),
        }
        value = reads.get((command, tuple(arguments)))
        return b"1\xb6" + value.encode("latin-1") if value is not None else self._order(command, arguments).encode()

    def _gradients(self) -> dict[tuple[str, tuple[str, ...]], str]:
        if self.gradient_K_per_min is None:
            return {}
        return {("11066", ("1",)): f"{self.gradient_K_per_min:.1f}", ("11070", ("1",)): "0.0"}

    def _messages(self) -> dict[tuple[str, tuple[str, ...]], str]:
        """Two: an information that always stands, and the alarm."""
        rows = (("info", "4", "1"), (f"alarm {self.alarm}", "1", str(int(bool(self.alarm)))))
        return {("17002", ()): str(len(rows))} | {
            (number, (str(index),)): row[column]
            for index, row in enumerate(rows, 1)
            for number, column in (("17007", 0), ("17005", 1), ("17009", 2))
        }

    def _order(self, command: str, arguments: list[str]) -> str:
        match command, arguments:
            case "11001", [str(variable), str(value)]:
                if variable != "1":
                    return _NO_CHANNEL
                taken = re.fullmatch(r"-?\d+(\.\d+)?", value) and self.set(float(value))
                return _ACCEPTED if taken else _BAD_PARAMETER
            case "19015", []:
                self.program_degC = None
                return _ACCEPTED
            case "14001", ["1", "0" | "1"] if self.program_degC is None:
                self.switch(arguments[1] == "1")
                return _ACCEPTED
            case "14001", ["1", "0" | "1"]:
                return _ACCEPTED
            case "14001", ["2", "0" | "1"]:
                self.humidity_on = arguments[1] == "1"
                return _ACCEPTED
            case "14001" | "14003", _:
                return _NO_CHANNEL
            case _:
                return _NO_COMMAND


def chamber_fake(protocol: str, make: Callable[[Plant, Now, Mapping[str, Any]], FakeClimateChamber]) -> None:
    """A make answers at its address under its protocol; its controller allows the set-points that it should."""

    @fake(f"climate_chamber.{protocol}", rank=CONTROL)
    def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeClimateChamber:
        chamber = make(bench.plant, bench.clock, settings)
        chamber.is_alone = not bench.has_relays
        low_degC, high_degC = settings["limits_degC"]
        chamber.limits_degC = low_degC, high_degC
        bench.listen(name, settings["address"], chamber.engine)
        return chamber


def _cts(plant: Plant, clock: Now, settings: Mapping[str, Any]) -> FakeCts:
    return FakeCts(plant, clock, settings["unit"], is_serial=settings["address"].startswith("serial:"))


chamber_fake("espec", lambda plant, clock, _: FakeEspec(plant, clock))
chamber_fake("cts", _cts)
chamber_fake("ascii2", lambda plant, clock, settings: FakeWeiss(plant, clock, settings["unit"]))
chamber_fake("julabo", lambda plant, clock, _: FakeJulabo(plant, clock))
chamber_fake("simserv", lambda plant, clock, settings: FakeSimserv(plant, clock, settings["chamber"]))
