"""Instruments in the laboratory that answer in text lines: a reference thermometer, a hygrometer.

Sources: Fluke 1504 user's guide 7.3 (commands end with CR or LF; T, FETC?, *IDN?), HMT330 user's guide M210566EN
p. 90-102 (commands end with CR; SEND, the default output). The serial numbers are ours.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any, Literal

from thermostand.drivers.sim.fakes import OWN_LINE, Bench, fake
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.foundation.clock import Now

ProbeKind = Literal["hart", "vaisala"]
_NOISE_K, _NOISE_PERCENT = 0.002, 0.05


class FakeProbe:
    """A probe outside the chamber. humidity_percent: of the laboratory's air. Faults: silent; failed (it shows stars
    or dashes instead of a number); fahrenheit (somebody has changed its unit); serial_number; echo (it repeats what it
    was asked, as in full duplex)."""

    def __init__(self, plant: Plant, clock: Now, kind: ProbeKind, serial_number: str, seed: int) -> None:
        self._plant = plant
        self._clock = clock
        self._kind: ProbeKind = kind
        self._seed = seed
        self.serial_number = serial_number
        self.humidity_percent = 45.0
        self.silent = self.failed = self.fahrenheit = self.echo = False

    def engine(self) -> ProbeEngine:
        """A new conversation."""
        return ProbeEngine(self)

    def answer(self, command: str) -> str:
        """The lines that a command brings, "" for one that it does not know."""
        if self.silent:
            return ""
        with self._plant.at(self._clock) as now_ns:
            T_degC = self._plant.laboratory_degC
        chance = random.Random(f"{self._seed} {self._kind} {now_ns}")
        T_degC += chance.gauss(0.0, _NOISE_K)
        shown, unit = (T_degC * 1.8 + 32, "F") if self.fahrenheit else (T_degC, "C")
        if self._kind == "hart":
            return self._hart(command, shown, unit)
        if command.lower() != "send":
            return "Unknown command\r\n>" if command else ">"
        humidity = self.humidity_percent + chance.gauss(0.0, _NOISE_PERCENT)
        numbers = ("*****", "*****") if self.failed else (f"{humidity:5.1f}", f"{shown:5.1f}")
        return f"RH={numbers[0]} %RH T={numbers[1]} '{unit}\r\n>"

    def _hart(self, command: str, shown: float, unit: str) -> str:
        match command.lower():
            case "t":
                return f"t: {'********' if self.failed else f'{shown:8.3f}'} {unit}\r\n"
            case "fetc?" | "fetch?":
                return f"{shown:8.3f}\r\n"
            case "*idn?":
                return f"HART,1504,{self.serial_number},1.02\r\n"
            case _:
                return ""


class ProbeEngine:
    """Commands in, lines out."""

    def __init__(self, probe: FakeProbe) -> None:
        self._probe = probe
        self._pending = ""

    def feed(self, data: bytes) -> bytes:
        """The answers to the commands that are whole."""
        *commands, self._pending = (self._pending + data.decode("latin-1")).replace("\n", "\r").split("\r")
        replies = (
            (f"{command}\r\n" if self._probe.echo and not self._probe.silent else "") + self._probe.answer(command)
            for command in commands
        )
        return "".join(replies).encode("latin-1")


@fake("probes.hart", "probes.vaisala", rank=OWN_LINE)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeProbe:
    serial_number = settings["serial_number"] or "P-1"
    probe = FakeProbe(bench.plant, bench.clock, settings["protocol"], serial_number, bench.seed)
    bench.listen(name, settings["address"], probe.engine)
    return probe
