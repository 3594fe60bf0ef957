"""A Julabo circulator on its wire, with the plant behind its bath. Source: FL1201 owner's manual, chapter 11 (commands,
status and error messages); an `out` command is not answered, and is valid in remote control only."""

from __future__ import annotations

import re

from drivers.sim.units.climate_chambers import Chamber, Conversation, FakeClimateChamber
from foundation.clock import Now

_VERSION = "JULABO TEST 1.0 V 1.20"
_NOT_NOW = "-09 COMMAND NOT ALLOWED IN CURRENT OPERATING MODE"


class FakeJulabo(FakeClimateChamber):
    """remote: whether somebody has chosen remote control at its panel. A message about a command stands until `status`
    was asked once; alarm: the text of one that stands until it is cleared, such as 01 LOW LEVEL ALARM."""

    def __init__(self, plant: Chamber, clock: Now) -> None:
        super().__init__(plant, clock)
        self.remote = True
        self._message = ""

    def engine(self) -> Conversation:
        """Commands that end with CR; replies end with CR LF."""

        def take(buffer: bytes) -> tuple[bytes, bytes] | None:
            command, separator, rest = buffer.partition(b"\r")
            if not separator:
                return None
            reply = self._answer(command.decode("latin-1").strip())
            return reply.encode("ascii") + b"\r\n" if reply else b"", rest

        return Conversation(self, take)

    def _answer(self, command: str) -> str:
        match command:
            case "version":
                return _VERSION
            case "status":
                return self._status()
            case "in_pv_00":
                return f"{self.actual_degC:.2f}"
            case "in_sp_00":
                return f"{self.setpoint_degC:.2f}"
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
            if self.set(float(found[1])):
                return ""
            return "-10 VALUE TOO SMALL" if float(found[1]) < self.limits_degC[0] else "-11 VALUE TOO LARGE"
        if found := re.fullmatch(r"out_mode_05 ([01])", command):
            self.switch(found[1] == "1")
            return ""
        return "-08 INVALID COMMAND"
