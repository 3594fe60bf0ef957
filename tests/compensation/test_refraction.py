"""Refraction at the chamber's opening: the paper's 4 um, and Snell's law ray by ray."""

from __future__ import annotations

import math

import numpy as np
import pytest

from thermostand.compensation.budget.budget import (
    ciddor_1996,
    compute_ray_shift_mm,
    compute_refraction_px,
    compute_tilt_shift_mm,
    edlen_1966,
)

WARM, LABORATORY = (1 + ciddor_1996(degC, 101325.0, 0.0, 0.55) for degC in (54.0, 24.0))


@pytest.mark.parametrize(
    ("distance_mm", "part", "at_140_um", "at_180_um"),
    [
        (826, 0.1, -3.21, -4.20),
        (826, 0.3, -2.50, -3.27),
        (826, 0.5, -1.78, -2.34),
        (1000, 0.1, -3.18, -4.14),
        (1000, 0.3, -2.47, -3.22),
        (1000, 0.5, -1.77, -2.30),
        (1500, 0.1, -3.15, -4.07),
        (1500, 0.3, -2.45, -3.17),
        (1500, 0.5, -1.75, -2.26),
    ],
)
def test_the_shift_at_30_K(distance_mm: float, part: float, at_140_um: float, at_180_um: float):
    shift = compute_ray_shift_mm(np.array([140.0, 180.0]), distance_mm, part * distance_mm, WARM, LABORATORY)
    assert 1e3 * shift == pytest.approx([at_140_um, at_180_um], abs=0.01)


def test_the_papers_4_um_are_reproduced_with_its_own_formula():
    warm, laboratory = (1 + edlen_1966(degC, 101325.0, 0.0, 0.55) for degC in (54.0, 24.0))
    corner_mm = math.hypot(1224, 1024) * 0.114
    at_corner_um = -1e3 * float(compute_ray_shift_mm(corner_mm, 826.0, 82.6, warm, laboratory))
    assert at_corner_um == pytest.approx(4.2, abs=0.1)
    assert -1e3 * float(compute_ray_shift_mm(corner_mm, 826.0, 413.0, warm, laboratory)) < 3


def test_it_is_a_scale_but_for_a_hundredth_of_a_micrometre_or_so():
    radius_mm = np.linspace(1, 180, 50)
    shift_um = 1e3 * compute_ray_shift_mm(radius_mm, 826.0, 82.6, WARM, LABORATORY)
    scale = radius_mm @ shift_um / (radius_mm @ radius_mm)
    assert np.abs(shift_um - scale * radius_mm).max() < 0.08


def test_a_ray_that_leaves_where_the_point_appears_reaches_the_point():
    focal_px, distance_mm, interface_mm = 7246.0, 826.0, 250.0
    n1, n2 = 1.0002, 1.0003
    straight_px = np.array([[1000.0, -700.0], [0.0, 0.0]])
    seen_px = straight_px + compute_refraction_px(straight_px, focal_px, distance_mm, interface_mm, n1, n2)
    tangent = np.linalg.norm(seen_px, axis=1) / focal_px
    sine2 = n1 / n2 * np.sin(np.arctan(tangent))
    reached_mm = interface_mm * tangent + (distance_mm - interface_mm) * np.tan(np.arcsin(sine2))
    aimed_mm = np.linalg.norm(straight_px, axis=1) / focal_px * distance_mm
    assert reached_mm == pytest.approx(aimed_mm, abs=1e-5)
    assert np.linalg.norm(seen_px[0]) > np.linalg.norm(straight_px[0])


@pytest.mark.parametrize(("tilt_deg", "um"), [(5, 1.5), (15, 4.6), (0, 0.0)])
def test_a_tilted_interface_moves_the_whole_image(tilt_deg: float, um: float):
    assert 1e3 * compute_tilt_shift_mm(math.radians(tilt_deg), 1000.0, 300.0, WARM, LABORATORY) == pytest.approx(
        um, abs=0.06
    )
