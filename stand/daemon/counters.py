"""What wears, counted over the life of a stand: compressor, relays, flap, stages, and the heat that was given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from thermostand.foundation.clock import NS_PER_S, seconds_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Item
from thermostand.foundation.readings import Quality, Reading

_UNSEEN_NS = seconds_ns(60.0)  # between two readings: what happened in a longer gap is unknown, and not counted
_S_PER_H = 3600.0
_OPEN_ABOVE = 0.5  # of the flap's travel


class Counters:
    """A subscriber of the hub. `values`, by name:

    compressor_hours, compressor_starts; relay_cycles.NAME: how often the relay was switched on; flap_cycles: how often
    it was opened; stage_cycles.NAME: how many moves of the axis were seen; heater_Wh: output x heater_W, permitted.
    """

    def __init__(self, earlier: Mapping[str, float], axes: Iterable[str], heater_W: float, hub: Hub) -> None:
        self.values = {
            "compressor_hours": 0.0,
            "compressor_starts": 0.0,
            "flap_cycles": 0.0,
            "heater_Wh": 0.0,
            **earlier,
        }
        self._axes = tuple(axes)
        self._heater_W = heater_W
        self._last: dict[str, Reading] = {}
        hub.subscribe(self._receive)

    def _receive(self, item: Item) -> None:
        if isinstance(item, Batch):
            for reading in item.readings:
                if reading.quality is not Quality.BAD:
                    self._count(reading, self._last.get(reading.channel))
                    self._last[reading.channel] = reading

    def _count(self, reading: Reading, before: Reading | None) -> None:
        if before is None:
            return
        device, _, name = reading.channel.partition(".")
        span_ns = reading.time_ns - before.time_ns
        span_h = span_ns / NS_PER_S / _S_PER_H if 0 < span_ns <= _UNSEEN_NS else 0.0
        rises = reading.value > _OPEN_ABOVE >= before.value
        if device == "relays":
            if rises:
                self._add(f"relay_cycles.{name}", 1)
            if name == "compressor":
                self._add("compressor_starts", rises)
                self._add("compressor_hours", span_h if before.value == 1 else 0.0)
        elif reading.channel == "flap.position":
            self._add("flap_cycles", rises)
        elif device in self._axes and name == "position" and self._begins_to_move(reading, before):
            self._add(f"stage_cycles.{device}", 1)
        elif reading.channel == "regulator.mv_heat" and self._is_permitted():
            self._add("heater_Wh", before.value / 100 * self._heater_W * span_h)

    def _begins_to_move(self, reading: Reading, before: Reading) -> bool:
        """A move is counted where its first change is seen: one that lies between two polls, too."""
        device = reading.channel.partition(".")[0]
        moving = self._last.get(f"{device}.moving")
        return reading.value != before.value and (moving is None or moving.value == 0)

    def _is_permitted(self) -> bool:
        permit = self._last.get("relays.heater_enable")
        return permit is not None and permit.value == 1

    def _add(self, name: str, amount: float) -> None:
        self.values[name] = self.values.get(name, 0.0) + amount
