"""What another night adds: assumed of one night, and known better with each that is compared."""

from __future__ import annotations

import numpy as np
import pytest

from thermostand.compensation.drift.thermal_model import between_nights

NONE_PX2 = np.zeros((0, 2))


def test_of_one_night_it_is_assumed_and_says_so():
    found = between_nights(np.array([0.0, 0.010]), NONE_PX2)
    assert found.is_assumed
    assert "assumed, not measured" in found.text
    # Four nights' worth: Student's t of 4 degrees of freedom reaches 2.776 where a normal distribution reaches 1.960.
    assert found.sigma_px == pytest.approx((0.002 * 2.776 / 1.96, np.hypot(0.002, 0.008) * 2.776 / 1.96), rel=1e-3)


def test_nights_that_agree_make_it_smaller_and_nights_that_do_not_larger():
    left_px = np.array([0.004, 0.004])
    agreeing = [between_nights(left_px, np.full((nights, 2), left_px**2)).sigma_px[0] for nights in (0, 2, 4, 12)]
    assert agreeing == sorted(agreeing, reverse=True)
    assert agreeing[-1] < 0.5 * agreeing[0]
    off_px2 = np.full((2, 2), 0.020**2)
    found = between_nights(left_px, off_px2)
    assert not found.is_assumed
    assert found.sigma_px[0] > 2 * agreeing[0]
    assert "as 2 nights show" in found.text


def test_with_many_nights_it_is_what_they_show():
    """Nights that differ by 10 mpx, one standard deviation."""
    rng = np.random.default_rng(1)
    left_px2 = 0.003**2 + (0.010 * rng.standard_normal((400, 2))) ** 2
    assert between_nights(np.full(2, 0.003), left_px2).sigma_px == pytest.approx((0.010, 0.010), rel=0.1)
