"""Values of a configuration that would disarm a rule: a file may have them only if `guard.overrides` names their paths.

The ranges of the fields themselves are wider, and no file can exceed them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
from numpy.polynomial import Polynomial

from thermostand.drivers.devices.thermometers import PLAUSIBLE_DEGC, ThermometerSettings

_MOST_K = 1e9  # JSON has no infinity


@dataclass(frozen=True, slots=True)
class SafeRange:
    """The range from `low` to `high` within which the value at `path` disarms nothing; `reason` is what it would do
    outside."""

    path: str
    unit: str
    reason: str
    low: float = -math.inf
    high: float = math.inf

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        least = f"at least {self.low:g}{self.unit}" if math.isfinite(self.low) else ""
        return least or f"at most {self.high:g}{self.unit}"


SAFE_RANGES = (
    SafeRange("compressor.min_off_s", " s", "a compressor started against its own pressure stalls", low=180),
    SafeRange("compressor.min_on_s", " s", "a compressor stopped so soon loses the oil it has pumped out", low=60),
    SafeRange("compressor.max_starts_per_h", "", "each start heats the compressor's winding", high=12),
    SafeRange("guard.sensors.trip_K", " K", "a probe that has come loose would go unnoticed", high=10),
    SafeRange("guard.sensors.trip_after_s", " s", "a probe that has come loose would control for too long", high=600),
    SafeRange("guard.stale_after_s", " s", "it would be heated for so long without knowing the temperature", high=30),
    SafeRange(
        "guard.panel_change_grace_s", " s", "a set-point changed by hand would be followed for so long", high=120
    ),
    SafeRange(
        "guard.flap_open_s", " s", "an open flap lets the chamber's air at the optics and the laboratory", high=3600
    ),
    SafeRange("guard.flap_capture_s", " s", "a capture that hangs would leave the flap open for so long", high=7200),
    SafeRange("guard.disk_low_s", " s", "it would be heated for so long without recording frames", high=1800),
    SafeRange(
        "guard.camera_temperature_s", " s", "frames without the camera's temperature fit no model of drift", high=300
    ),
    SafeRange("recording.stop_frames_below_GB", " GB", "telemetry would find the disk full", low=0.5),
    SafeRange("bus.timeout_s", " s", "the guard could wait longer for a silent unit than a permit lives", high=2),
)
# On drawn chambers without such a thermometer both probes that are 0.3 K low, or drift alike, are not found: the air
# went to 85 degC. With a safety thermometer every failure stays below the limit.
_AIR_SENSOR = SafeRange(
    "independent_air_sensor",
    "",
    "no thermometer would show that the regulator's probe and the air's are wrong alike; give another one "
    "`role: granite_inside`, or `role: safety` in the chamber's air",
    low=1,
)
_CORRECTION = "a temperature that far from what the module indicates is a slip in the file, and hides heat"


def find_outside(config: object, thermometers: Mapping[str, ThermometerSettings]) -> dict[str, float]:
    """The values of `config` outside their safe ranges, by their paths."""
    return {safe.path: value for safe, value in _list_values(config, thermometers) if value not in safe}


def check(config: object, thermometers: Mapping[str, ThermometerSettings], accepted: Sequence[str]) -> None:
    """ValueError with a sentence for each value that is outside its range and not `accepted`, and for each entry of
    `accepted` that is no such path, is given twice, or has a value within its range."""
    found = list(_list_values(config, thermometers))
    faults = [
        _describe_refusal(safe, value) for safe, value in found if value not in safe and safe.path not in accepted
    ]
    known = {safe.path: (safe, value) for safe, value in found}
    for path in dict.fromkeys(accepted):
        if path not in known:
            faults.append(f"guard.overrides: {path} is not a path that can be overridden; those are {', '.join(known)}")
        elif known[path][1] in known[path][0]:
            safe, value = known[path]
            faults.append(f"guard.overrides: {path} is not needed: {value:g}{safe.unit} is within its range ({safe})")
        if accepted.count(path) > 1:
            faults.append(f"guard.overrides: {path} is given twice")
    if faults:
        raise ValueError("; ".join(faults))


def _list_values(config: object, thermometers: Mapping[str, ThermometerSettings]) -> Iterator[tuple[SafeRange, float]]:
    for safe in SAFE_RANGES:
        yield safe, float(attrgetter(safe.path)(config))
    yield _AIR_SENSOR, float(len(attrgetter("independent_air_sensors")(config)))
    for name, entry in thermometers.items():
        path = f"thermometers.{name}.polynomial"
        yield (
            SafeRange(path, " K", _CORRECTION, high=10),
            compute_largest_correction_K(entry.offset_K, entry.polynomial),
        )


def _describe_refusal(safe: SafeRange, value: float) -> str:
    low_degC, high_degC = PLAUSIBLE_DEGC
    what = f"{value:g}{safe.unit}"
    if safe.reason == _CORRECTION:
        what = f"with offset_K a correction of up to {what} over {low_degC:g} to {high_degC:g} degC"
    return (
        f"{safe.path}: {what} is outside the safe range ({safe}): {safe.reason}; choose a value within it, or name "
        f"{safe.path} in guard.overrides"
    )


def compute_largest_correction_K(offset_K: float, polynomial: Sequence[float]) -> float:
    """The largest distance, K, of a corrected temperature from the indicated one over PLAUSIBLE_DEGC; 1e9 when it is
    more, or cannot be computed."""
    low_degC, high_degC = PLAUSIBLE_DEGC
    with np.errstate(all="ignore"):
        correction = Polynomial([offset_K]) + Polynomial(polynomial or [0.0])
        try:
            turns = correction.trim().deriv().trim().roots()
        except np.linalg.LinAlgError:
            return _MOST_K
        inside = [turn.real for turn in turns if low_degC < turn.real < high_degC]
        largest_K = float(np.max(np.abs(correction(np.array([low_degC, high_degC, *inside])))))
    return min(largest_K, _MOST_K) if math.isfinite(largest_K) else _MOST_K


def describe_accepted(accepted: Mapping[str, float]) -> str:
    """The sentence, shown at each start, on values outside their safe ranges that `guard.overrides` allows."""
    ranges = {safe.path: str(safe) for safe in (*SAFE_RANGES, _AIR_SENSOR)}
    usual = "a correction of at most 10 K"
    weakened = [f"{path} {value:g} (safe: {ranges.get(path, usual)})" for path, value in accepted.items()]
    return f"guard.overrides weakens the protection: {', '.join(weakened)}"
