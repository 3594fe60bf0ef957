"""The part of a stand's state that does not depend on a run: what was read last, and what is switched on."""

from __future__ import annotations

import importlib.metadata
from functools import cache

from thermostand.foundation.clock import Clock, utc_offset_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.readings import Quality, Reading
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.serving.desk import ReadingState, StandState
from thermostand.stand.serving.not_confirmed import NotConfirmed
from thermostand.stand.stand import Stand


def seen_state(config: StandConfig, stand: Stand, hub: Hub, clock: Clock) -> StandState:
    """A stand on which nothing is run, as its devices were last read."""
    readings = hub.readings
    heat_percent, cool_percent = _value(readings.get("regulator.mv_heat")), _value(readings.get("regulator.mv_cool"))
    output_percent = None if heat_percent is None else heat_percent - (cool_percent or 0.0)
    return StandState(
        stand=config.name,
        version=_version(),
        simulated=config.simulation is not None,
        now_ns=clock.now_ns(),
        utc_offset_ns=utc_offset_ns(clock),
        phase="idle",
        reasons=tuple(sorted(stand.gate.reasons)),
        not_confirmed=_not_confirmed(stand),
        readings={channel: _reading(reading) for channel, reading in readings.items()},
        setpoint_degC=_value(readings.get("regulator.sp")) if _value(readings.get("regulator.running")) else None,
        output_percent=output_percent,
        heater_permitted=stand.chamber.permits.granted,
        compressor_on=bool(_value(readings.get("relays.compressor"))),
        camera_on=stand.imaging.supply.is_on,
        flap=_flap(config, stand),
        axes={name: _value(readings.get(f"{name}.position")) for name in stand.devices.axes},
        moving=tuple(stand.motions.texts),
        busy=stand.motions.names,
    )


def _not_confirmed(stand: Stand) -> tuple[NotConfirmed, ...]:
    permits = stand.chamber.permits
    return tuple(
        NotConfirmed(
            name=each.name,
            since_ns=each.since_ns,
            reason=each.failure,
            timer_s=permits.timer_s if each.name == permits.name else None,
        )
        for each in stand.safety.pending
    )


def _flap(config: StandConfig, stand: Stand) -> str:
    if config.flap is None:
        return "none"
    return "moving" if stand.motions.moves("flap") else "open" if stand.imaging.flap_open else "closed"


def _value(reading: Reading | None) -> float | None:
    return None if reading is None or reading.quality is Quality.BAD else reading.value


def _reading(reading: Reading) -> ReadingState:
    return ReadingState.model_construct(
        value=_value(reading),
        unit=reading.unit,
        quality=reading.quality,
        time_ns=reading.time_ns,
        reason=reading.reason,
        cause=reading.cause,
    )


@cache
def _version() -> str:
    return importlib.metadata.version("thermostand")
