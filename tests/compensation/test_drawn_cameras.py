"""The drawn cameras are what their numbers say: published ranges, and effects that can be switched."""

from __future__ import annotations

import numpy as np
import pytest

from .drawn_cameras import (
    ALL_EFFECTS,
    Camera,
    Float,
    centres_px,
    compute_settled_degC,
    draw_camera,
    nodes_degC,
    target_mm,
)
from .drawn_sessions import cycle, make_full_session, make_unseen_begin, record_session, reference, warm_up

STILL = np.zeros((1, 2))
SEEDS = range(12)


def settled_px(camera: Camera, air_degC: float) -> Float:
    return centres_px(camera, compute_settled_degC(camera, air_degC)[None], STILL)[0]


def width_px(centres: Float) -> float:
    return float(centres[:, 0].max() - centres[:, 0].min())


@pytest.mark.parametrize("seed", SEEDS)
def test_scale_and_principal_point_are_in_the_published_ranges(seed: int) -> None:
    camera = draw_camera(seed)
    warm, cold = settled_px(camera, 25.0), settled_px(camera, 23.0)
    ppm_per_K = 1e6 * (width_px(warm) / width_px(cold) - 1) / 2
    assert -40 < ppm_per_K < 55
    assert abs(ppm_per_K) > 10
    moved = np.linalg.norm(camera.body_px_per_K + camera.cell_px_per_K)
    assert 0.005 < moved < 0.18


@pytest.mark.parametrize("seed", SEEDS)
def test_a_camera_settles_within_the_published_times(seed: int) -> None:
    camera = draw_camera(seed)
    step = np.full(12 * 360, 34.0)
    step[0] = 24.0
    nodes = nodes_degC(camera, step, np.ones(len(step)))
    left = np.abs(nodes - compute_settled_degC(camera, 34.0)).max(axis=1) / np.abs(nodes[0] - nodes[-1]).max()
    minutes = 10 / 60 * float(np.flatnonzero(left > np.exp(-1))[-1])
    assert 4 < minutes < 100


def test_each_effect_changes_what_is_recorded_and_nothing_else_does() -> None:
    plain = record_session(draw_camera(3), make_full_session())
    again = record_session(draw_camera(3), make_full_session())
    assert np.array_equal(plain.truth_px, again.truth_px)
    for name in ALL_EFFECTS:
        other = record_session(draw_camera(3, name), make_full_session())
        moved = np.abs(other.truth_px - plain.truth_px).max()
        if name in ("coarse_sensor", "far_air"):
            assert moved == 0
            column = "camera_degC" if name == "coarse_sensor" else "air_degC"
            assert np.abs(getattr(other.observed, column) - getattr(plain.observed, column)).max() > 0.2
        else:
            assert 0.003 < moved < 2.0, name


def test_a_switched_off_camera_tells_no_temperature_and_is_as_cold_as_the_air() -> None:
    made = record_session(draw_camera(1), [*warm_up(), *reference()])
    history = made.observed.histories[0]
    assert len(history.camera_ns) < len(history.ambient_ns) / 2
    assert abs(made.observed.camera_degC[0] - made.observed.air_degC[0]) < 6
    assert made.observed.camera_degC[-1] - made.observed.air_degC[-1] > 8


def test_what_was_before_the_record_moves_the_image_and_is_not_in_the_history() -> None:
    camera = draw_camera(1)
    parts = [*reference(), *cycle()]
    unseen, known = record_session(camera, parts, unrecorded=make_unseen_begin()), record_session(camera, parts)
    assert 0.02 < np.abs(unseen.truth_px[0] - known.truth_px[0]).max() < 2.0
    history = unseen.observed.histories[0]
    before_s = (unseen.observed.time_ns[0] - history.ambient_ns[0]) / 1e9
    assert before_s == pytest.approx(2700, abs=20)
    assert history.camera_degC[0] - history.ambient_degC[0] > 4


def test_a_target_further_away_is_seen_smaller_and_a_turned_one_narrower() -> None:
    camera = draw_camera(3)
    nodes = compute_settled_degC(camera, 24.0)[None]
    usual, far, turned = (
        centres_px(camera, nodes, STILL, target_mm(*place))[0] for place in ((0.0, 0.0), (82.6, 0.0), (0.0, 60.0))
    )
    assert np.array_equal(usual, settled_px(camera, 24.0))
    assert width_px(far) == pytest.approx(width_px(usual) / 1.1, rel=2e-3)  # distortion is the rest
    assert width_px(turned) == pytest.approx(width_px(usual) / 2, rel=0.03)
