"""When the refrigeration compressor runs: the regulator's cooling output is a wish, the compressor's health decides.

The regulator's cooling period (at most 99 s) is far shorter than a compressor's minimum off time, so its output is
read as a demand. Once started, the compressor keeps running and the heater trims the temperature, as in commercial
climate chambers: that holds the air steady, where cycling at full stroke would swing it by kelvins. It stops when the
regulator heats hard against it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from drivers.clock import seconds_ns


@dataclass(frozen=True, slots=True)
class CompressorLimits:
    """Minimum off and on times (s), starts per hour, and the regulator outputs (%) that start and stop it."""

    min_off_s: float
    min_on_s: float
    max_starts_per_h: int
    start_above_cool_percent: float
    stop_above_heat_percent: float


@dataclass(frozen=True, slots=True)
class CompressorState:
    """`since_ns`: when it was last switched; `starts_ns`: starts of the last hour."""

    running: bool
    since_ns: int
    starts_ns: tuple[int, ...] = ()


def decide(
    state: CompressorState, limits: CompressorLimits, mv_heat: float, mv_cool: float, now_ns: int
) -> CompressorState:
    """The compressor's state from now on; outputs in %, NaN (an unknown output) never starts it."""
    hour_ago_ns = now_ns - seconds_ns(3600)
    starts_ns = tuple(start for start in state.starts_ns if start > hour_ago_ns)
    held_ns = now_ns - state.since_ns
    if state.running:
        unwanted = mv_heat > limits.stop_above_heat_percent and not mv_cool > 0
        if unwanted and held_ns >= seconds_ns(limits.min_on_s):
            return CompressorState(running=False, since_ns=now_ns, starts_ns=starts_ns)
        return replace(state, starts_ns=starts_ns)
    wanted = mv_cool > limits.start_above_cool_percent and mv_heat <= 0
    rested = held_ns >= seconds_ns(limits.min_off_s)
    if wanted and rested and len(starts_ns) < limits.max_starts_per_h:
        return CompressorState(running=True, since_ns=now_ns, starts_ns=(*starts_ns, now_ns))
    return replace(state, starts_ns=starts_ns)
