"""Simulated cameras of configs/optics: how fast they warm, how far their image goes, and what each effect adds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import pytest

from thermostand.drivers.camera_preset import CameraPreset, Effect
from thermostand.drivers.sim.physics.optics import PITCH_mm
from thermostand.drivers.sim.physics.published_camera import PublishedCamera
from thermostand.foundation.documents import load_document

OPTICS = Path(__file__).parents[2] / "configs" / "optics"
PRESETS = sorted(path.stem for path in OPTICS.glob("*.yaml"))
STEP_S = 10.0
REPEATING: tuple[Effect, ...] = ("sag", "dead_zone", "creep")


@dataclass
class Air:
    """A plant that is nothing but air."""

    air_degC: float = 24.0
    camera_powered: bool = False


class Bench:
    """A camera in air that the test sets."""

    def __init__(self, preset: str, *effects: Effect, drawn: int | None = None, seed: str = "night 1") -> None:
        self.preset = load_document(OPTICS / f"{preset}.yaml", CameraPreset)
        self.air = Air()
        self.camera = PublishedCamera(self.preset, self.air, STEP_S, effects, drawn, seed)

    def wait(self, hours: float, air_degC: float | None = None) -> tuple[float, float]:
        """The sensor's place afterwards, px, without roll."""
        if air_degC is not None:
            self.air.air_degC = air_degC
        for _ in range(round(hours * 3600 / STEP_S)):
            self.camera.step(0, STEP_S)
        return self.place_px()

    def place_px(self, roll_rad: float = 0.0) -> tuple[float, float]:
        x_mm, y_mm = self.camera.optics(roll_rad).sensor_mm
        return x_mm / PITCH_mm, y_mm / PITCH_mm


def record_px(bench: Bench) -> list[tuple[float, float]]:
    """Up and down again, an hour each, powered."""
    bench.air.camera_powered = True
    return [bench.wait(1.0, air_degC) for air_degC in (24.0, 34.0, 44.0, 34.0, 24.0, 14.0, 24.0)]


def test_the_four_documented_ones_exist():
    assert PRESETS == ["dic", "nac", "navcam", "phone"]


@pytest.mark.parametrize("drawn", [None, 4])
@pytest.mark.parametrize("name", PRESETS)
def test_settled_it_is_within_what_its_file_says(name: str, drawn: int | None):
    bench = Bench(name, drawn=drawn)
    low_bend, high_bend = (10.0 * each for each in bench.preset.bend_per_K)
    assert bench.place_px() == (0.0, 0.0)
    bench.wait(15.0, 34.0)
    assert bench.camera.sensor_degC == pytest.approx(34.0, abs=0.01)
    ppm_per_K = 1e6 * bench.camera.optics(0.0).stretch / 10.0
    at_bounds = [each * (1 + bend) for each in bench.preset.scale_ppm_per_K for bend in (low_bend, high_bend)]
    assert min(at_bounds) - 0.1 <= ppm_per_K <= max(at_bounds) + 0.1
    assert math.hypot(*bench.place_px()) <= 10.0 * bench.preset.principal_point_px_per_K[1] * (1 + high_bend)
    bench.air.camera_powered = True
    bench.wait(15.0)
    low_K, high_K = bench.preset.self_heating_K
    assert low_K - 0.01 <= bench.camera.sensor_degC - 34.0 <= high_K + 0.01


def test_its_slowest_part_settles_with_the_time_constant_of_its_file():
    bench = Bench("phone")
    slowest_s = 60 * sum(bench.preset.settling_min) / 2
    bench.wait(4 * slowest_s / 3600, 34.0)
    early_K = 34.0 - bench.camera.body_degC
    bench.wait(slowest_s / 3600)
    assert math.log(early_K / (34.0 - bench.camera.body_degC)) == pytest.approx(1.0, rel=0.03)


def test_what_repeats_is_the_same_in_another_session_and_what_does_not_is_another():
    cases: list[tuple[tuple[Effect, ...], bool]] = [
        (REPEATING, True),
        (("stick_slip",), False),
        (("unrepeated",), False),
    ]
    for effects, is_same in cases:
        sessions = [record_px(Bench("dic", *effects, seed=f"night {number}")) for number in (1, 2)]
        assert (sessions[0] == sessions[1]) == is_same


def test_each_effect_can_be_switched_and_leaves_the_others_as_they_are():
    plain = record_px(Bench("nac", drawn=3))
    alone = {name: record_px(Bench("nac", name, drawn=3)) for name in REPEATING}
    together = record_px(Bench("nac", *REPEATING, drawn=3))
    for at, (x, y) in enumerate(together):
        added = [sum(each[at][axis] - plain[at][axis] for each in alone.values()) for axis in (0, 1)]
        assert (x - plain[at][0], y - plain[at][1]) == pytest.approx(added, abs=1e-9)
    assert all(math.dist(each[2], plain[2]) > 0.002 for each in alone.values())


def test_a_dead_zone_leaves_another_place_on_the_way_down():
    for bench, is_closed in ((Bench("dic"), True), (Bench("dic", "dead_zone"), False)):
        up, _, down = bench.wait(15.0, 34.0), bench.wait(15.0, 44.0), bench.wait(15.0, 34.0)
        assert (math.dist(up, down) < 1e-4) == is_closed


def test_creep_goes_on_after_everything_has_settled():
    moved_px: list[float] = []
    for bench in (Bench("phone"), Bench("phone", "creep")):
        early = bench.wait(4.0, 44.0)
        moved_px.append(math.dist(early, bench.wait(4.0)))
    assert moved_px[0] < 1e-3 < 0.03 < moved_px[1]


def test_sag_goes_down_in_the_laboratory_whichever_way_the_camera_is_turned():
    bench, plain = Bench("dic", "sag"), Bench("dic")
    for each in (bench, plain):
        each.wait(15.0, 54.0)
    for roll_rad in (0.0, math.pi / 2, math.pi):
        (x, y), (x0, y0) = bench.place_px(roll_rad), plain.place_px(roll_rad)
        sag_px = math.hypot(x - x0, y - y0)
        assert sag_px > 0.05
        assert (x - x0, y - y0) == pytest.approx((sag_px * math.sin(roll_rad), sag_px * math.cos(roll_rad)))


def test_a_coarse_sensor_is_late_offset_and_in_half_kelvins():
    coarse, fine = Bench("dic", "coarse_sensor", drawn=5), Bench("dic", drawn=5)
    for each in (coarse, fine):
        each.air.camera_powered = True
        each.wait(0.05)
    assert (coarse.camera.sensor_degC * 2).is_integer()
    early_K = coarse.camera.sensor_degC - fine.camera.sensor_degC
    for each in (coarse, fine):
        each.wait(15.0)
    late_K = coarse.camera.sensor_degC - fine.camera.sensor_degC
    low_K, high_K = coarse.preset.coarse_sensor.offset_K
    assert low_K - 0.25 <= late_K <= high_K + 0.25
    assert early_K < late_K - 0.4


def test_a_far_thermometer_of_the_air_is_late_and_has_a_share_of_its_change():
    bench = Bench("dic", "far_air")
    assert Bench("dic").camera.far_air_degC is None
    assert bench.camera.far_air_degC == 24.0
    bench.wait(20 / 3600, 44.0)
    early_degC = bench.camera.far_air_degC
    bench.wait(10.0)
    share = sum(bench.preset.far_air.share) / 2
    assert bench.camera.far_air_degC == pytest.approx(24.0 + 20.0 * share, abs=1e-6)
    assert early_degC is not None
    assert 26.0 < early_degC < 38.0


def test_drawn_cameras_differ_and_are_the_same_each_time():
    sessions = {number: record_px(Bench("navcam", drawn=number)) for number in (None, 1, 2)}
    assert len({session[2] for session in sessions.values()}) == 3
    assert record_px(Bench("navcam", drawn=2)) == sessions[2]
