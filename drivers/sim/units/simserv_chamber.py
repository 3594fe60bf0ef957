"""A Weiss or Voetsch chamber with SIMSERV on its wire: fields are parted by a byte B6. Source: public transcripts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from thermostand.drivers.sim.fakes import CONTROL, Bench, fake
from thermostand.drivers.sim.units.climate_chambers import Chamber, Conversation, FakeClimateChamber, built
from thermostand.foundation.clock import Now

_ACCEPTED, _NO_COMMAND, _BAD_PARAMETER, _NO_CHANNEL = "1", "-5", "-6", "-8"


class FakeSimserv(FakeClimateChamber):
    """Control variable 1; digital channel 1 starts, 2 is humidity. An unknown number is answered by -5, a set-point
    outside of the limits by -6. gradient_K_per_min: upwards, 0 for none; None for a unit that does not know them.
    A program goes on when the start channel is cleared, until it is ended (19015)."""

    def __init__(self, plant: Chamber, clock: Now, chamber: int = 1) -> None:
        super().__init__(plant, clock)
        self._chamber = str(chamber)
        self.gradient_K_per_min: float | None = 0.0
        self.serial_number = "58226123450010"

    def engine(self) -> Conversation:
        """Commands that end with CR; replies end with CR LF."""

        def take(buffer: bytes) -> tuple[bytes, bytes] | None:
            command, separator, rest = buffer.partition(b"\r")
            if not separator:
                return None
            return self._answer(command.lstrip(b"\n").split(b"\xb6")) + b"\r\n", rest

        return Conversation(self, take)

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


@fake("climate_chamber.simserv", rank=CONTROL)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeSimserv:
    return built(bench, name, settings, FakeSimserv(bench.plant, bench.clock, settings["chamber"]))
