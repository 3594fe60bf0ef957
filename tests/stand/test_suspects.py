"""Which of two channels that contradict each other is named: the one that moved unlike the rest, when that is known."""

import math
from collections.abc import Callable

import pytest

from thermostand.foundation.clock import to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Quality, Reading
from thermostand.stand.config.chamber_section import ChamberConfig
from thermostand.stand.guarding.interlocks import limit_disagreement
from thermostand.stand.guarding.rules import limit_sensor_drift
from thermostand.stand.guarding.sensor_diagnosis import SensorHistory, name_suspect
from thermostand.stand.safety.fault import Fault

PV, AIR, CEILING, GRANITE, CAMERA = (
    "regulator.pv",
    "thermometers.air",
    "thermometers.ceiling",
    "thermometers.granite_inside",
    "camera.temperature",
)
HEAT, PERMIT, SP, COMPRESSOR, FLAP = (
    "regulator.mv_heat",
    "relays.heater_enable",
    "regulator.sp",
    "relays.compressor",
    "flap.position",
)
LAGS_S = {GRANITE: 4000.0, CAMERA: 600.0}
REST_S, FAULT_S = 900, 900


def ramp(kelvins: float, over_s: float = 600.0) -> Callable[[float], float]:
    return lambda since_s: kelvins * min(1.0, max(0.0, since_s / over_s))


def still(since_s: float) -> float:
    return 0.0


def found(
    pair: tuple[str, str],
    moves: dict[str, Callable[[float], float]],
    others: dict[str, float] | None = None,
    reported: str = "",
) -> Fault | None:
    """What a disagreement of 3 K says of air at rest of 30 degC, from which channels move (K by seconds since then);
    others: what heat, cold and set-point are since."""
    settings = {HEAT: 20.0, PERMIT: 1.0, SP: 30.0, COMPRESSOR: 0.0, FLAP: 0.0}
    witnesses = SensorHistory(
        [name for name in (PV, AIR, CEILING) if name in moves],
        {name: lag_s for name, lag_s in LAGS_S.items() if name in moves},
        ChamberConfig(),
        ("regulator", PERMIT),
        (FLAP,),
        (SP, COMPRESSOR),
    )
    hub, rule = Hub(), name_suspect(limit_disagreement(*pair, 3.0), pair, witnesses)
    for second in range(0, REST_S + FAULT_S, 5):
        since_s, now_ns = second - REST_S, to_ns(second)
        values = {name: 30.0 + 20.0 * (name == CAMERA) + move(since_s) for name, move in moves.items()}
        values |= settings | ((others or {}) if since_s >= 0 else {})
        readings = [Reading(name, value, "1", now_ns) for name, value in values.items()]
        if reported and since_s > 0:
            readings.append(Reading(reported, values[reported], "1", now_ns, Quality.STALE, "it jumped", "suspect"))
        hub.publish(Batch("stand", now_ns, tuple(readings)))
        if (fault := rule(hub, now_ns)) is not None:
            return fault
    return None


def follows(move: Callable[[float], float], lag_s: float) -> Callable[[float], float]:
    """A body of that lag, in steps of 5 s from the begin of the fault."""
    reached: dict[int, float] = {0: 0.0}

    def at(since_s: float) -> float:
        if since_s <= 0:
            return 0.0
        for second in range(max(reached) + 5, int(since_s) + 1, 5):
            reached[second] = reached[second - 5] + (1 - math.exp(-5 / lag_s)) * (move(second) - reached[second - 5])
        return reached[int(since_s)]

    return at


UP, DOWN = ramp(8.0), ramp(-8.0)
BODIES_OF_UP = {CAMERA: follows(UP, 600.0), GRANITE: follows(UP, 4000.0)}


@pytest.mark.parametrize(
    ("moves", "others", "reported", "suspect"),
    [
        ({PV: still, AIR: still, CEILING: UP}, {}, "", None),
        ({PV: UP, AIR: still, CEILING: still}, {}, "", PV),
        ({PV: still, AIR: DOWN, CEILING: still}, {}, "", AIR),
        ({PV: still, AIR: UP, CEILING: UP}, {}, "", PV),
        ({PV: still, AIR: UP, **BODIES_OF_UP}, {HEAT: 60.0, SP: 45.0}, "", PV),
        ({PV: UP, AIR: still, **BODIES_OF_UP}, {HEAT: 60.0, SP: 45.0}, "", AIR),
        ({PV: UP, AIR: still}, {HEAT: 100.0, SP: 45.0}, "", AIR),
        ({PV: still, AIR: DOWN}, {HEAT: 0.0, SP: 20.0, COMPRESSOR: 1.0}, "", PV),
        ({PV: still, AIR: ramp(5.0, 60.0)}, {}, "", AIR),
        ({PV: still, AIR: ramp(5.0, 60.0)}, {FLAP: 1.0}, "", ""),
        ({PV: ramp(2.0), AIR: ramp(-2.0)}, {HEAT: 25.0}, "", ""),
        ({PV: UP, AIR: still, CEILING: still}, {}, AIR, AIR),
    ],
    ids=[
        "they agree",
        "PV alone",
        "air alone",
        "PV stays",
        "PV stays, bodies warm",
        "air stays, bodies warm",
        "air stays under full heat",
        "PV stays in the cold",
        "air moves from rest",
        "the flap may have moved it",
        "both a little",
        "one in doubt",
    ],
)
def test_two_probes(
    moves: dict[str, Callable[[float], float]], others: dict[str, float], reported: str, suspect: str | None
):
    fault = found((PV, AIR), moves, others, reported)
    if suspect is None:
        assert fault is None
        return
    assert fault is not None
    assert (fault.channels, fault.suspect) == ((PV, AIR), suspect)
    assert fault.data["suspect"] == suspect
    assert PV in fault.text
    assert AIR in fault.text


@pytest.mark.parametrize(
    ("body", "probe", "suspect"), [(UP, still, GRANITE), (still, ramp(-8.0), AIR)], ids=["the body", "the probe"]
)
def test_a_body_and_a_probe(body: Callable[[float], float], probe: Callable[[float], float], suspect: str):
    fault = found((GRANITE, AIR), {PV: still, AIR: probe, GRANITE: body})
    assert fault is not None
    assert fault.suspect == suspect


@pytest.mark.parametrize(
    ("drifts", "thirds", "suspect"),
    [(AIR, (CEILING,), AIR), (PV, (CEILING,), PV), (AIR, (), ""), (CEILING, (CEILING,), None)],
    ids=["air", "PV", "no third", "another one"],
)
def test_a_drift(drifts: str, thirds: tuple[str, ...], suspect: str | None):
    hub, rule, fault = Hub(), limit_sensor_drift((AIR, PV), SP, (), 0.1, thirds), None
    for second in range(0, 12 * 3600, 60):
        now_ns, drift_K = to_ns(second), 0.02 * second / 3600
        values = {name: 40.0 + drift_K * (name == drifts) for name in (AIR, PV, CEILING)} | {SP: 40.0}
        hub.publish(Batch("stand", now_ns, tuple(Reading(name, value, "1", now_ns) for name, value in values.items())))
        fault = rule(hub, now_ns) or fault
    assert (fault and fault.suspect) == suspect
