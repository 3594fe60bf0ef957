"""What the paper reports (Sensors 2018, 18, 3685, section 7): figure 15's averages and Table 1, mm."""

from __future__ import annotations

from dataclasses import dataclass

Triple = tuple[float, float, float]

BEFORE_mm: Triple = (0.0177, 0.1343, 0.1420)
AFTER_mm: Triple = (0.0124, 0.0254, 0.0287)
"""Mean over 11 temperatures of the mean absolute deviations of V0..V3, along X, Y, Z."""


@dataclass(frozen=True, slots=True)
class PaperTemperature:
    """One temperature of Table 1. camera_degC: of the sensor. before_mm, after_mm: deviations of V0..V3."""

    camera_degC: float
    before_mm: tuple[Triple, ...]
    after_mm: tuple[Triple, ...]
    mean_before_mm: Triple
    mean_after_mm: Triple


TABLE_1 = (
    PaperTemperature(
        55.55,
        ((0.0171, 0.0289, 0.1174), (-0.0093, 0.0193, 0.2016), (0.0000, 0.0537, 0.0174), (0.0157, 0.0341, 0.0481)),
        ((0.0093, -0.0034, 0.0354), (-0.0139, -0.0081, 0.0341), (-0.0041, 0.0312, -0.0761), (0.0092, 0.0150, -0.0244)),
        (0.0105, 0.0340, 0.0961),
        (0.0091, 0.0144, 0.0425),
    ),
    PaperTemperature(
        67.05,
        (
            (-0.0366, -0.1943, 0.1911),
            (-0.0129, -0.2312, 0.3267),
            (-0.0352, -0.2235, 0.2352),
            (-0.0344, -0.2015, 0.1775),
        ),
        ((0.0026, -0.0058, -0.0156), (0.0327, -0.0121, 0.1198), (0.0228, 0.0592, 0.0187), (0.0234, 0.0873, -0.0455)),
        (0.0298, 0.2126, 0.2326),
        (0.0204, 0.0411, 0.0499),
    ),
)
