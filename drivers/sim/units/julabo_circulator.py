"""A Julabo circulator on its wire, with the plant behind its bath. Source: FL1201 owner's manual, chapter 11 (commands,
status and error messages); an `out` command is not answered, and is valid in remote control only."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from thermostand.drivers.sim.fakes import CONTROL, Bench, fake
from thermostand.drivers.sim.units.climate_chambers import Chamber, Conversation, FakeClimateChamber, built
from thermostand.foundation.clock import Now

_VERSION = "JULABO TEST 1.0 V 1.20"
_INVALID = "-08 INVALID COMMAND"
_NOT_NOW = "-09 COMMAND NOT ALLOWED IN CURRENT OPERATING MODE"


class FakeJulabo(FakeClimateChamber):
    """remote: whether somebody has chosen remote control at its panel. A message about a command stands until `status`
    was asked once; alarm: the text of one that stands until it is cleared, such as 01 LOW LEVEL ALARM.

    bank: the working temperature that acts, 0 for T1 (which is what sp_00 sets), 1 for T2, 2 for T3. external: a sensor
    outside is controlled. degF: every temperature on its wire is. unknown: queries that this unit does not have, to
    which it says nothing but -08 in its status, or answers it when `answers_unknown`.
    """

    def __init__(self, plant: Chamber, clock: Now) -> None:
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
        """Of the working temperature that is chosen; with a sensor outside the bath goes further than that."""
        chosen_degC = (self.setpoint_degC, *self.others_degC)[self.bank]
        return chosen_degC + 20.0 if self.external else chosen_degC

    def engine(self) -> Conversation:
        """Commands that end with CR; replies end with CR LF."""

        def take(buffer: bytes) -> tuple[bytes, bytes] | None:
            command, separator, rest = buffer.partition(b"\r")
            if not separator:
                return None
            reply = self._answer(command.decode("latin-1").strip())
            return reply.encode("ascii") + b"\r\n" if reply else b"", rest

        return Conversation(self, take)

    def _shown(self, degC: float) -> str:
        return f"{degC * 9 / 5 + 32 if self.degF else degC:.2f}"

    def _answer(self, command: str) -> str:
        if command in self.unknown:
            self._message = "" if self.answers_unknown else _INVALID
            return _INVALID if self.answers_unknown else ""
        match command:
            case "version":
                return _VERSION
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
            return _NOT_NOW
        if found := re.fullmatch(r"out_sp_00 (-?\d+\.\d{1,2})", command):
            degC = (float(found[1]) - 32) * 5 / 9 if self.degF else float(found[1])
            if self.set(degC):
                return ""
            return "-10 VALUE TOO SMALL" if degC < self.limits_degC[0] else "-11 VALUE TOO LARGE"
        if found := re.fullmatch(r"out_mode_05 ([01])", command):
            self.switch(found[1] == "1")
            return ""
        return _INVALID


@fake("climate_chamber.julabo", rank=CONTROL)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeJulabo:
    return built(bench, name, settings, FakeJulabo(bench.plant, bench.clock))
