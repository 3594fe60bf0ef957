"""Branches, closure and repeatability of drifts that are known."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from thermostand.compensation.drift.hysteresis import hysteresis
from thermostand.compensation.drift.paper_model import fit_paper
from thermostand.compensation.drift.thermal_learning import fit_thermal
from thermostand.compensation.observations import Observations

from .reservoirs import cycle, reference, session, warm_up
from .synthetic import FIT_DEGC, observations, places_px, quadratic

WAY_DEGC = (31.0, 45.0, 31.0, 24.0, 10.0, 24.0)


def visited(opening_px: float, cycles: int = 1, creep_px: float = 0.0, noise_px: float = 0.0) -> Observations:
    """Set-points in the order of WAY_DEGC; on the way down J is lower by the opening, each cycle adds creep to I."""
    way = (24.0, *WAY_DEGC * cycles)
    still = observations(quadratic, noise_px, fit_degC=WAY_DEGC * cycles, held_out_degC=())
    visit = np.concatenate([np.zeros(8, int), 1 + np.arange(len(WAY_DEGC) * cycles).repeat(2)])
    falls = np.array([False] + [later < earlier for earlier, later in pairwise(way)])
    cycle_of = np.maximum(visit - 1, 0) // len(WAY_DEGC)
    moved = np.stack([creep_px * cycle_of, -opening_px * falls[visit]], axis=1)
    return replace(still, centres_px=still.centres_px + moved[:, None])


def test_the_gap_between_the_branches_is_found_with_its_uncertainty():
    (found,) = hysteresis(visited(0.05, noise_px=0.004))
    assert [gap.chamber_degC for gap in found.gaps] == [24.0, 31.0]
    for gap in found.gaps:
        np.testing.assert_allclose(gap.uncertainty_px, 0.004 * np.sqrt((1 + 1 / 8) / 54), rtol=0.01)
        assert (np.abs(gap.difference_px - [0, 0.05]) < 4 * gap.uncertainty_px).all()
    np.testing.assert_allclose(found.largest_px, [0, 0.05], atol=0.003)
    np.testing.assert_allclose(found.rms_px, [0, 0.05], atol=0.003)
    np.testing.assert_allclose(found.area_px_K, [0, 0.05 * 7], atol=0.02)
    hot, cold = (quadratic(places_px(), above_K).mean(axis=0)[1] for above_K in (21.0, -14.0))
    assert found.range_px[1] == pytest.approx(hot - cold + 0.05, abs=0.003)  # 10 degC is reached from above


def test_no_opening_is_no_hysteresis():
    (found,) = hysteresis(visited(0.0))
    np.testing.assert_allclose(found.largest_px, 0, atol=1e-9)
    np.testing.assert_allclose(found.closure_px, 0, atol=1e-9)
    assert np.isnan(found.repeatability_px).all()


def test_what_does_not_come_back_is_closure_and_repeatability():
    (found,) = hysteresis(visited(0.0, cycles=2, creep_px=0.02))
    np.testing.assert_allclose(found.closure_px, [0.02, 0], atol=1e-9)
    assert 0.5 * 0.02 / np.sqrt(2) < found.repeatability_px[0] <= 0.02 / np.sqrt(2) + 1e-9
    assert found.repeatability_px[1] == pytest.approx(0, abs=1e-9)


def test_a_camera_with_play_opens_and_the_thermal_form_closes_it():
    loose, _ = session(warm_up(24.0) + reference() + cycle(), plays=True)
    (before,) = hysteresis(loose)
    (paper,) = hysteresis(loose, fit_paper(loose, 2))
    (after,) = hysteresis(loose, fit_thermal(loose))
    assert before.rms_px[1] > 0.1
    assert paper.rms_px[1] > 0.5 * before.rms_px[1]
    assert after.rms_px[1] < 0.2 * before.rms_px[1]


def test_one_way_only_has_no_gaps():
    (found,) = hysteresis(observations(quadratic, fit_degC=FIT_DEGC[3:], held_out_degC=()))
    assert found.gaps == ()
    assert np.isnan(found.largest_px).all()
    assert np.isnan(found.rms_px).all()
