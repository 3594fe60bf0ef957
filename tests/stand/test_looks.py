"""Each look at the chamber that does not believe the probes, alone: what makes it object, and what it forgives."""

import math
from collections.abc import Callable

from thermostand.foundation.clock import to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.config.chamber_section import (
    CameraCrosscheckConfig,
    ChamberConfig,
    GraniteCrosscheckConfig,
    HeatBalanceConfig,
    StartupResponseConfig,
    SteadyStatePowerConfig,
)
from thermostand.stand.guarding.heat_balance import limit_heat_energy, require_heat_response
from thermostand.stand.guarding.rules import limit_output_deviation, require_startup_response
from thermostand.stand.guarding.stuck_sensor import forbid_stuck_sensor
from thermostand.stand.guarding.thermal_crosscheck import crosscheck_by_camera, crosscheck_by_granite
from thermostand.stand.safety.fault import Rule

POLL_S = 5
PV, AIR, GRANITE, CAMERA = "regulator.pv", "thermometers.air", "thermometers.granite_inside", "camera.temperature"
PERMIT, COMPRESSOR, FLAP = "relays.heater_enable", "relays.compressor", "flap.position"
GRANITE_LAG_S, CAMERA_LAG_S = 4000, 600
GRANITE_LIMITS = GraniteCrosscheckConfig(limit_K=4, change_K=3)
CAMERA_LIMITS = CameraCrosscheckConfig(settle_s=1200, limit_K=6)
HEAT = HeatBalanceConfig(rise_share=0.15)
CHAMBER = ChamberConfig(heater_W=2000, heat_capacity_Wh_K=13)
NEEDED = SteadyStatePowerConfig(settle_s=600, limit_percent=25)
FIRST = StartupResponseConfig(within_s=120, rise_K=0.5)
AT_REST = {
    PV: 40.0,
    AIR: 40.0,
    GRANITE: 40.0,
    CAMERA: 60.0,
    "regulator.sp": 40.0,
    "regulator.mv_heat": 10.0,
    "regulator.mv_cool": 0.0,
    "regulator.running": 1.0,
    PERMIT: 1.0,
    COMPRESSOR: 0.0,
    FLAP: 0.0,
}


def noise_K(time_s: float) -> float:
    return 0.003 * math.sin(time_s * 1.7)


class Feed:
    """A rule over a hub that is polled; `run` gives when it first objects, s, and None when it does not."""

    def __init__(self, rule: Rule, poll_s: int = POLL_S) -> None:
        self.rule, self.hub, self.time_s, self.poll_s = rule, Hub(), 0, poll_s

    def run(self, duration_s: int, **changing: Callable[[float], float]) -> int | None:
        """`changing`: device_quantity -> its value so many s after the begin of this run; the rest is at rest."""
        begun_s = self.time_s
        for since_s in range(0, duration_s, self.poll_s):
            self.time_s = begun_s + since_s
            values = AT_REST | {name.replace("_", ".", 1): value(since_s) for name, value in changing.items()}
            time_ns = to_ns(self.time_s)
            readings = tuple(
                bad_reading(channel, "1", time_ns, "off")
                if math.isnan(value)
                else Reading(channel, value, "1", time_ns)
                for channel, value in values.items()
            )
            self.hub.publish(Batch("stand", time_ns, readings))
            if self.rule(self.hub, time_ns) is not None:
                return since_s
        self.time_s += self.poll_s
        return None


def constant(value: float) -> Callable[[float], float]:
    return lambda since_s: value


def test_granite_that_warms_tells_of_air_that_no_probe_shows():
    feed = Feed(crosscheck_by_granite(GRANITE_LIMITS, GRANITE_LAG_S, GRANITE, PV))
    assert feed.run(1200, thermometers_granite_inside=lambda s: 40 + noise_K(s)) is None
    warmed_s = feed.run(600, thermometers_granite_inside=lambda s: 40 + noise_K(s) + 8 * s / GRANITE_LAG_S)  # air of 48
    assert warmed_s is not None
    assert warmed_s <= 60


def test_one_wild_value_of_the_granite_is_no_warming():
    feed = Feed(crosscheck_by_granite(GRANITE_LIMITS, GRANITE_LAG_S, GRANITE, PV))
    assert feed.run(600, thermometers_granite_inside=lambda s: 40 + noise_K(s) + 30 * (s == 300)) is None


def test_granite_in_a_ramp_is_forgiven_a_lag_that_is_a_third_off():
    feed = Feed(crosscheck_by_granite(GRANITE_LIMITS, GRANITE_LAG_S, GRANITE, PV))
    true_lag_s, ramp_K_s = 0.7 * GRANITE_LAG_S, 0.05

    def granite(s: float) -> float:
        return 40 + noise_K(s) + ramp_K_s * (s - true_lag_s * (1 - math.exp(-s / true_lag_s)))

    assert feed.run(600, thermometers_granite_inside=granite, regulator_pv=lambda s: 40 + ramp_K_s * s) is None


def test_a_camera_that_warms_tells_when_its_own_excess_is_known():
    feed = Feed(crosscheck_by_camera(CAMERA_LIMITS, CAMERA_LAG_S, CAMERA, AIR))
    assert feed.run(1000, camera_temperature=lambda s: 60 - 20 * math.exp(-s / 300)) is None  # it warms itself up
    assert feed.run(1500) is None
    warmed_s = feed.run(900, camera_temperature=lambda s: 0.25 * round(4 * (60 + 15 * (1 - math.exp(-s / 600)))))
    assert warmed_s is not None
    assert warmed_s <= 400


def test_a_camera_that_was_off_is_learned_again_and_one_that_does_not_move_is_not_believed():
    feed = Feed(crosscheck_by_camera(CAMERA_LIMITS, CAMERA_LAG_S, CAMERA, AIR))
    assert feed.run(2500) is None
    assert feed.run(120, camera_temperature=constant(math.nan)) is None
    assert feed.run(2500, camera_temperature=constant(75.0)) is None
    assert feed.run(1200, camera_temperature=constant(75.0), thermometers_air=lambda s: 40 - s / 40) is None


def test_more_heat_within_an_hour_than_the_chamber_ever_needs():
    rule = limit_heat_energy(1400, 2000, "regulator", PERMIT)
    feed = Feed(rule)
    assert feed.run(7200, regulator_mv_heat=constant(65.0)) is None
    assert feed.run(7200, regulator_mv_heat=constant(100.0), relays_heater_enable=constant(0.0)) is None
    full_s = feed.run(7200, regulator_mv_heat=constant(100.0))
    assert full_s is not None
    assert abs(full_s - 1400 / 2000 * 3600) <= 60


def test_an_hour_of_heat_is_an_hour_however_often_it_is_looked_at():
    for poll_s in (1, 7, 50):
        feed = Feed(limit_heat_energy(1400, 2000, "regulator", PERMIT), poll_s)
        assert feed.run(4 * 3600, regulator_mv_heat=constant(69.5)) is None  # 1,390 Wh
        assert feed.run(4 * 3600, regulator_mv_heat=constant(75.0)) is not None


def test_a_probe_that_falls_or_stays_while_the_regulator_heats():
    def heated(pv: Callable[[float], float], set_point_degC: float = 60.0) -> int | None:
        feed = Feed(require_heat_response(HEAT, CHAMBER, PV, "regulator", PERMIT))
        assert feed.run(300) is None
        return feed.run(600, regulator_pv=pv, regulator_sp=constant(set_point_degC), regulator_mv_heat=constant(100.0))

    assert heated(lambda s: 24 + 16 * math.exp(-s / 30)) in range(5, 30)  # it was pulled out
    assert heated(lambda s: 30.0) == 0  # its value jumped
    assert heated(lambda s: min(45.0, 40 + s / 20)) in range(180, 260)  # stuck on the way
    assert heated(lambda s: 40 + s / 60) is None
    assert heated(constant(40.0), 40.5) is None  # it only holds


def test_an_output_far_from_what_was_needed():
    feed = Feed(limit_output_deviation(NEEDED, "regulator", PERMIT, COMPRESSOR, FLAP))
    assert feed.run(2400) is None
    assert feed.run(3600, regulator_mv_heat=constant(45.0), relays_compressor=constant(1.0)) is None  # learned apart
    assert feed.run(3600, regulator_mv_heat=constant(60.0), regulator_sp=constant(60.0)) is None  # in a ramp
    assert feed.run(1200, regulator_mv_heat=constant(60.0), flap_position=constant(1.0)) is None
    objected_s = feed.run(3600, regulator_mv_heat=constant(36.0))
    assert objected_s is not None
    assert 900 <= objected_s <= 910


def test_a_fine_thermometer_without_noise_is_frozen_only_while_the_output_works():
    def rule() -> Rule:
        return forbid_stuck_sensor(AIR, (AIR, GRANITE), "regulator")

    def noisy(step_K: float) -> Callable[[float], float]:
        return lambda s: 40 + step_K * ((s // POLL_S) % 3)

    assert Feed(rule()).run(900, thermometers_granite_inside=noisy(0.003)) == 300  # from the begin
    assert Feed(rule()).run(900, thermometers_granite_inside=noisy(0.1)) is None  # a module of 0.1 K
    idle = {"regulator_mv_heat": constant(0.0), "thermometers_granite_inside": noisy(0.003)}
    assert Feed(rule()).run(900, **idle) is None
    assert Feed(rule()).run(900, thermometers_air=noisy(0.003)) is None


def test_the_first_heat_must_reach_both_probes():
    def heated(pv_K: float, air_K: float) -> int | None:
        feed = Feed(require_startup_response(FIRST, AIR, "regulator", PERMIT))
        assert feed.run(300) is None
        return feed.run(
            600,
            regulator_pv=lambda s: 40 + pv_K * min(1.0, s / 120),
            thermometers_air=lambda s: 40 + air_K * min(1.0, s / 120),
            regulator_sp=constant(60.0),
            regulator_mv_heat=constant(80.0),
        )

    assert heated(3.0, 0.0) == 120
    assert heated(0.0, 3.0) == 120
    assert heated(3.0, 3.0) is None


def test_after_the_first_heat_nothing_more_is_asked():
    feed = Feed(require_startup_response(FIRST, AIR, "regulator", PERMIT))

    def rising(since_s: float) -> float:
        return 40 + since_s / 50

    heat = {"regulator_sp": constant(60.0), "regulator_mv_heat": constant(80.0)}
    assert feed.run(120, regulator_pv=rising, thermometers_air=rising, **heat) is None
    assert feed.run(600, **heat) is None
