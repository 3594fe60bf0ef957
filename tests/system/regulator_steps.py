"""Steps of the set-point with one regulator or another, over the wires in virtual time, and what autotuning finds."""

from __future__ import annotations

import asyncio
import math
import statistics
import tempfile
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tests.system.virtual_stand import VirtualStand, bare_config, virtual_stand
from thermostand.drivers.devices.regulators.pid import Law
from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulator

Kind = Literal["simulated", "software-regulator"]
FROM_degC, FROM_s = 20.0, 5400.0
STEPS = ((45.0, 3 * 3600.0), (10.0, 4 * 3600.0), (30.0, 3 * 3600.0))
TUNED_AT_degC = 45.0
BAND_K, REST_s = 0.1, 1800.0
DRAWN = range(1, 11)  # chambers


@dataclass(frozen=True)
class Step:
    """One step of the set-point, seen by one channel. rise_s: 10 to 90 %; settled_s: until it stays within 0.1 K; rms_K
    and worst_K: of the last 30 min; cycles_per_h: of the heat's relay; starts_per_h: of the compressor."""

    set_point_degC: float
    rise_s: float
    overshoot_K: float
    settled_s: float
    rms_K: float
    worst_K: float
    cycles_per_h: float
    starts_per_h: float


def steps_of(kind: Kind, chamber_seed: int | None, law: Law | None = None, channel: str = "") -> list[Step]:
    """The steps with that regulator, its installed settings or `law`; by the air's thermometer."""
    return asyncio.run(_steps(kind, chamber_seed, law, channel or "thermometers.air"))


def autotune_in(chamber_seed: int | None) -> Law:
    """What autotuning finds there, from a law that suits nothing in particular."""
    return asyncio.run(_autotune(chamber_seed))


async def _autotune(chamber_seed: int | None) -> Law:
    async with _stand("software-regulator", chamber_seed, Law()) as stand:
        regulator = stand.assembly.devices.regulator
        assert isinstance(regulator, SoftwareRegulator)
        await stand.hold(TUNED_AT_degC, 1800)
        return await regulator.autotune()


async def _steps(kind: Kind, chamber_seed: int | None, law: Law | None, channel: str) -> list[Step]:
    async with _stand(kind, chamber_seed, law) as stand:
        pulses = _count_pulses(stand)
        await stand.hold(FROM_degC, FROM_s)
        found: list[Step] = []
        for set_point_degC, soak_s in STEPS:
            begin_s, pulses_before, events_before = stand.time_s, len(pulses), len(stand.events)
            await stand.hold(set_point_degC, soak_s)
            starts = [e for e in stand.events[events_before:] if e.kind == "compressor" and e.data["running"]]
            series = [(time_s - begin_s, degC) for time_s, degC in stand.series[channel] if time_s >= begin_s]
            hours = soak_s / 3600
            found.append(_step(set_point_degC, series, (len(pulses) - pulses_before) / hours, len(starts) / hours))
        assert stand.trips() == [], stand.trips()
        return found


def _stand(kind: Kind, chamber_seed: int | None, law: Law | None) -> AbstractAsyncContextManager[VirtualStand]:
    sections: dict[str, dict[str, object]] = {"simulation": {"chamber_seed": chamber_seed}}
    if law is not None:
        sections["regulator"] = {"law": law.model_dump(mode="json")}
    return virtual_stand(bare_config(kind, Path(tempfile.mkdtemp(prefix="regulators-")), sections))


def _count_pulses(stand: VirtualStand) -> list[int]:
    """Instants at which the heat's relay closes, as commanded from now on."""
    relays, closed, until_ns = stand.assembly.devices.relays, list[int](), [0]
    hold_on = relays.hold_on

    async def counted(channel: str, duration_s: float) -> None:
        now_ns = stand.clock.now_ns()
        if channel == "heat":
            if now_ns >= until_ns[0]:
                closed.append(now_ns)
            until_ns[0] = now_ns + int(duration_s * 1e9)
        await hold_on(channel, duration_s)

    relays.hold_on = counted
    return closed


def _step(set_point_degC: float, series: list[tuple[float, float]], cycles: float, starts: float) -> Step:
    from_degC = series[0][1]
    way_K = set_point_degC - from_degC
    shares = [(time_s, (degC - from_degC) / way_K) for time_s, degC in series]
    rise_s = next(t for t, share in shares if share >= 0.9) - next(t for t, share in shares if share >= 0.1)
    errors = [(time_s, degC - set_point_degC) for time_s, degC in series]
    rest = [error_K for time_s, error_K in errors if time_s >= series[-1][0] - REST_s]
    return Step(
        set_point_degC,
        rise_s,
        max(0.0, *(error_K * math.copysign(1, way_K) for _, error_K in errors)),
        max(time_s for time_s, error_K in errors if abs(error_K) > BAND_K),
        math.sqrt(statistics.fmean(error_K**2 for error_K in rest)),
        max(map(abs, rest)),
        cycles,
        starts,
    )
