"""Pt100 sensors where the plant has them, as the converter of an RTD module sees them, of whatever make it is."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from typing import Protocol

from thermostand.drivers.sim.units.modbus import ILLEGAL_ADDRESS, Handler, Refusal, Timeline, answer
from thermostand.foundation.clock import Now

CHANNELS = 6

STILL_AIR_LAG_S = 30.0  # of a sensor that hangs in the laboratory
NOISE_K = 0.003
NOISY_K = 1.0


class Places(Timeline, Protocol):
    """Where the sensors of the plant sit; temperatures at grid time now_ns."""

    now_ns: int
    granite_inside_degC: float
    granite_outside_degC: float
    artifact_degC: float
    air_degC: float
    chamber_degC: float
    laboratory_degC: float


class RtdModule:
    """A module of six channels as unit `unit`; `channels` says which sensor is on which, counted from `first` on:
    granite_inside, granite_outside, artifact, air, laboratory; any other name hangs in the chamber's air. Channels
    without a sensor are open.

    The noise of a reading is a pure function of (seed, channel, grid time of the plant), however often it is read.
    Faults, by channel number: open_channels, shorted_channels, stuck_degC (the converter gives this and no noise),
    held_degC (the sensor is held there), noisy_channel (1 K instead of 3 mK), offset_K, drift_K_per_h, pulled_out (of
    the chamber). air_exchanged: the air's sensor is where the regulator's probe belongs. silent.
    """

    functions: Mapping[int, Handler]

    def __init__(
        self, plant: Places, clock: Now, unit: int, channels: Mapping[str, int], seed: int, first: int = 0
    ) -> None:
        places: dict[str, Callable[[], float]] = {
            "granite_inside": lambda: plant.granite_inside_degC,
            "granite_outside": lambda: plant.granite_outside_degC,
            "artifact": lambda: plant.artifact_degC,
            "laboratory": lambda: plant.laboratory_degC,
            "air": self._air_of_models_degC,
        }
        if not set(channels.values()) <= set(range(first, first + CHANNELS)):
            raise ValueError(f"thermometer channels {dict(channels)}: expected {first}..{first + CHANNELS - 1}")
        self.unit = unit
        self.silent = False
        self.open_channels: set[int] = set()
        self.shorted_channels: set[int] = set()
        self.stuck_degC: dict[int, float] = {}
        self.held_degC: dict[int, float] = {}
        self.noisy_channel: int | None = None
        self.offset_K: dict[int, float] = {}
        self.drift_K_per_h: dict[int, float] = {}
        self.pulled_out: set[int] = set()
        self.air_exchanged = False
        self.far_air_degC: Callable[[], float | None] = lambda: None  # where "air" hangs far from the camera
        self._first = first
        self._plant = plant
        self._clock = clock
        self._seed = seed
        self._sensors = {number: places.get(name, self._air_degC) for name, number in channels.items()}
        self._drifted_K: dict[int, float] = {}
        self._loose_degC: dict[int, float] = {}  # of the sensors that hang in the laboratory
        self._random = random.Random()
        self._drawn_ns = 0
        self._drawn: dict[int, float] = {}  # noise at that time by channel, in units of its standard deviation
        plant.on_step.append(self._on_step)

    def handle(self, pdu: bytes) -> bytes | None:
        """The reply to a request."""
        with self._plant.lock:
            self._plant.advance(self._clock.now_ns())
            return None if self.silent else answer(pdu, self.functions)

    def measured_degC(self, place: int) -> float:
        """What the converter sees on the channel at that place of the module, 0 is the first: an open wire is far above
        every range, a short far below."""
        channel = self._first + place
        if channel in self.open_channels or channel not in self._sensors:
            return float("inf")
        if channel in self.shorted_channels:
            return float("-inf")
        if channel in self.stuck_degC:
            return self.stuck_degC[channel]
        noise_K = self._noise(channel) * (NOISY_K if channel == self.noisy_channel else NOISE_K)
        wrong_K = self.offset_K.get(channel, 0.0) + self._drifted_K.get(channel, 0.0)
        felt_degC = self.held_degC.get(channel, self._loose_degC.get(channel, self._sensors[channel]()))
        return felt_degC + noise_K + wrong_K

    def _air_degC(self) -> float:
        return self._plant.chamber_degC if self.air_exchanged else self._plant.air_degC

    def _air_of_models_degC(self) -> float:
        far_degC = self.far_air_degC()
        return self._air_degC() if far_degC is None or self.air_exchanged else far_degC

    def _noise(self, channel: int) -> float:
        """Drawn once in a step of the plant: the values and the fault bits of a poll ask for it alike."""
        if self._drawn_ns != self._plant.now_ns:
            self._drawn_ns, self._drawn = self._plant.now_ns, {}
        if channel not in self._drawn:
            self._random.seed(f"{self._seed} {channel} {self._drawn_ns}")
            self._drawn[channel] = self._random.gauss(0.0, 1.0)
        return self._drawn[channel]

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        for channel, rate_K_per_h in self.drift_K_per_h.items():
            self._drifted_K[channel] = self._drifted_K.get(channel, 0.0) + rate_K_per_h * dt_s / 3600
        if self.pulled_out or self._loose_degC:
            self._loosen(dt_s)

    def _loosen(self, dt_s: float) -> None:
        """Sensors outside go to the laboratory's temperature, in still air; those put back are where they belong."""
        loose, outside_degC = self._loose_degC, self._plant.laboratory_degC
        was = {channel: loose.get(channel, self._sensors[channel]()) for channel in self.pulled_out}
        self._loose_degC = {
            channel: degC + (outside_degC - degC) * dt_s / STILL_AIR_LAG_S for channel, degC in was.items()
        }


def check_span(address: int, count: int, begin: int) -> None:
    """Refusal outside of six addresses from `begin` on."""
    if not begin <= address or address + count > begin + CHANNELS:
        raise Refusal(ILLEGAL_ADDRESS)
