"""Which frames are drift, from where it is measured, and since when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermostand.compensation.history.thermal_history import ThermalHistory
from thermostand.compensation.observations import Observations, concatenate
from thermostand.compensation.reporting.drawing import report_figures
from thermostand.compensation.reporting.drawing.figures import Paths, as_svg, trajectories
from thermostand.compensation.reporting.tracks import cycle, moved_px, thinned, visits, warm_ups
from thermostand.experiments.steps import Role

from .synthetic import Float, facts, observations, places_px, quadratic

CENTRE_PX = np.array([1223.5, 1023.5])


def warm_up(session: str, roll_deg: float = 0.0, camera: str = "TS-0001") -> Observations:
    """24 to 36 degC in 12 frames, 500 ms apart, of a camera rolled by so much."""
    turn = np.radians(roll_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def seen(reference_px: Float, above_K: float) -> Float:
        rolled = CENTRE_PX + (reference_px - CENTRE_PX) @ rotation.T
        return rolled + np.array([0.01, 0.03]) * above_K

    found = observations(seen, fit_degC=(30.0, 36.0), held_out_degC=(), session=facts(session, camera))
    count = len(found.role)
    return replace(
        found,
        role=np.array(["warm_up"] * count),
        step_id=("warm-up",) * count,
        time_ns=found.time_ns[0] + np.arange(count) * 500_000_000,
    )


def powered(on_ns: list[int]) -> ThermalHistory:
    """Off at 0, on at each instant, off again after 1 s."""
    times = [0] + [time for on in on_ns for time in (on, on + 1_000_000_000)]
    empty = np.zeros(0, np.int64)
    values = np.array([0.0] + [1.0, 0.0] * len(on_ns))
    return ThermalHistory(empty, empty.astype(float), np.array(times, np.int64), values, empty, empty.astype(float))


def test_the_drift_is_measured_from_the_reference_or_else_from_the_first_frame():
    night = observations(quadratic)
    cold = observations(quadratic, fit_degC=(10.0, 24.0), held_out_degC=(), session=facts("cold"))
    cold = replace(cold, role=np.array(["warm_up"] * 12))
    moved = moved_px(concatenate([night, cold]))
    np.testing.assert_allclose(moved[:8], 0, rtol=0, atol=1e-9)
    assert np.abs(moved[-1]).max() < 1e-9  # 24 degC, as in its first frame
    expected = quadratic(night.centres_px[0], -14.0) - night.centres_px[0]
    np.testing.assert_allclose(moved[-3], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("role", [Role.CALIBRATION, Role.POSE, Role.REPEATABILITY, Role.OTHER])
def test_a_target_that_was_moved_on_purpose_is_no_drift(role: Role):
    night = observations(quadratic)
    centres, roles = night.centres_px.copy(), night.role.astype("U16")
    centres[10:13] += 28.0
    roles[10:13] = str(role)
    moved = moved_px(replace(night, centres_px=centres, role=roles))
    assert np.isnan(moved[10:13]).all()
    assert np.nanmax(np.abs(moved)) < 2


def test_a_warm_up_of_a_rolled_camera_is_measured_from_its_own_first_frame():
    both = concatenate([warm_up("upright"), warm_up("rolled", 20.0)])
    normal, rolled = warm_ups(both)
    assert normal.track.roll_deg == pytest.approx(0, abs=1e-6)
    assert rolled.track.roll_deg == pytest.approx(20, abs=1e-3)
    for one in (normal, rolled):
        np.testing.assert_allclose(one.track.mean_px[0], 0, atol=1e-9)
        np.testing.assert_allclose(one.track.mean_px[-1], [0.12, 0.36], atol=1e-9)
    assert np.nanmax(np.abs(moved_px(both))) < 1


def test_a_warm_up_rolled_before_the_reference_of_its_session_does_not_jump():
    night, rolled = observations(quadratic), warm_up("x", 20.0)
    roles = np.concatenate([np.array(["warm_up"] * 4), night.role[4:]])
    centres = np.concatenate([rolled.centres_px[:4], night.centres_px[4:]])
    assert np.nanmax(np.abs(moved_px(replace(night, role=roles, centres_px=centres)))) < 2


def test_a_warm_up_is_timed_from_when_the_camera_was_switched_on():
    cold = warm_up("cold")
    first = int(cold.time_ns[0])
    for on_ns, expected_s in (([first - 4_000_000_000], 4.0), ([first - 90_000_000_000, first - 3_000_000_000], 3.0)):
        (found,) = warm_ups(replace(cold, histories=(powered(on_ns),)))
        assert found.power_on_known
        assert found.since_on_s[:2] == pytest.approx([expected_s, expected_s + 0.5])
    for histories in ((), (powered([]),), (powered([first + 1]),)):
        (found,) = warm_ups(replace(cold, histories=histories))
        assert not found.power_on_known
        assert found.since_on_s[0] == 0


def test_visits_know_from_which_side_they_were_reached():
    night = observations(quadratic, fit_degC=(31.0, 38.0, 31.0, 10.0), held_out_degC=())
    track = cycle(night, 0)
    assert track is not None
    found = visits(night, track)
    assert [(one.chamber_degC, one.direction) for one in found] == [(24, 0), (31, 1), (38, 1), (31, -1), (10, -1)]
    expected = (quadratic(places_px(), 14.0) - places_px()).mean(axis=0)
    np.testing.assert_allclose(found[2].mean_px, expected, atol=1e-9)
    assert cycle(warm_up("cold"), 0) is None


def test_thinning_keeps_the_ends():
    assert thinned(5, 10).tolist() == [0, 1, 2, 3, 4]
    assert thinned(3600, 4).tolist() == [0, 1200, 2399, 3599]


def test_figures_bear_missing_frames_and_temperatures():
    night = observations(quadratic, 0.005)
    centres, air = night.centres_px.copy(), night.air_degC.copy()
    centres[3] = np.nan
    centres[:, 5] = np.nan
    air[:] = np.nan
    holes = replace(night, centres_px=centres, air_degC=air)
    assert np.isnan(moved_px(holes)[3]).all()
    track = cycle(holes, 0)
    assert track is not None
    paths = Paths("", track.start_px, track.moved_px, holes.camera_degC[track.frames])
    for figure in (trajectories(holes, [paths]), report_figures.against_time(holes)):
        assert as_svg(figure, "holes").startswith("<svg")


def test_what_a_thermal_imager_saw_stands_beneath_the_drift():
    night = observations(quadratic, 0.005)
    times_ns = np.linspace(night.time_ns[0] - 10**12, night.time_ns[-1] + 10**12, 1000).astype(np.int64)
    spots = {"lens": (times_ns, np.linspace(30.0, 50.0, 1000)), "back": (times_ns, np.full(1000, np.nan))}
    without, seen = night, replace(night, sessions=(replace(facts(), spots=spots),))
    assert len(report_figures.against_time(without).axes) == 2
    *_, foot = report_figures.against_time(seen).axes
    lens, _ = foot.lines
    hours = (night.time_ns[-1] - night.time_ns[0]) / 3.6e12
    shown = np.asarray(lens.get_xdata(), np.float64)
    assert 0 <= shown[0] < 0.01 * hours
    assert 0.99 * hours < shown[-1] <= hours
    assert [text.get_text() for text in foot.get_legend().get_texts()][:2] == ["lens", "back"]
    assert foot.get_ylabel() == "thermal imager (°C)"
