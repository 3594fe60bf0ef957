"""What air does to a ray from the camera to the target: its index, and a flat interface between warm and cold air.

The index: Edlen 1966 (the paper's) and Ciddor 1996 (the one to use). Arguments everywhere: temperature_degC,
pressure_Pa, vapour_Pa (partial pressure of water), wavelength_um (in vacuum). Results are n - 1, phase index.

The camera looks through air of index n1 to an interface at L1, square to the axis, then through laboratory air of n2 to
the target at D. A ray that leaves at theta to reach radius r = D tan(theta) arrives at r + shift (Snell):

    n1 sin(theta) = n2 sin(theta2)        shift = (D - L1)(tan(theta2) - tan(theta))

Nearly a pure scale, (1 - L1/D)(n1/n2 - 1): what is left is below 0.1 um at 180 mm.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

KELVIN = 273.15
_PA_PER_TORR = 133.322
_GAS_J_per_mol_K = 8.314472

Index = Callable[[float, float, float, float], float]
"""(temperature_degC, pressure_Pa, vapour_Pa, wavelength_um) -> n - 1."""


def saturation_Pa(temperature_degC: float) -> float:
    """Saturation vapour pressure over water (IAPWS-IF97, as NIST uses it), supercooled below 0 degC."""
    T = temperature_degC + KELVIN
    k1, k2, k3, k4, k5 = 1.16705214528e3, -7.24213167032e5, -1.70738469401e1, 1.20208247025e4, -3.23255503223e6
    k6, k7, k8, k9, k10 = 1.49151086135e1, -4.82326573616e3, 4.05113405421e5, -2.38555575678e-1, 6.50175348448e2
    omega = T + k9 / (T - k10)
    a = omega**2 + k1 * omega + k2
    b = k3 * omega**2 + k4 * omega + k5
    c = k6 * omega**2 + k7 * omega + k8
    return 1e6 * (2 * c / (-b + math.sqrt(b * b - 4 * a * c))) ** 4


def edlen_1966(temperature_degC: float, pressure_Pa: float, vapour_Pa: float, wavelength_um: float) -> float:
    """n - 1 by B. Edlen, The refractive index of air, Metrologia 2 (1966) 71."""
    S = wavelength_um**-2
    standard = (8342.13 + 2406030 / (130 - S) + 15997 / (38.9 - S)) * 1e-8
    p, pv = pressure_Pa / _PA_PER_TORR, vapour_Pa / _PA_PER_TORR
    density = p * (1 + p * (0.817 - 0.0133 * temperature_degC) * 1e-6) / (720.775 * (1 + 0.0036610 * temperature_degC))
    return standard * density - pv * (5.722 - 0.0457 * S) * 1e-8


def ciddor_1996(
    temperature_degC: float, pressure_Pa: float, vapour_Pa: float, wavelength_um: float, co2_ppm: float = 450.0
) -> float:
    """n - 1 by P. E. Ciddor, Refractive index of air: new equations for the visible, Appl. Opt. 35 (1996) 1566."""
    S = wavelength_um**-2
    axs = 1e-8 * (5792105 / (238.0185 - S) + 167917 / (57.362 - S)) * (1 + 5.34e-7 * (co2_ppm - 450))
    vs = 1.022e-8 * (295.235 + 2.6422 * S - 0.032380 * S**2 + 0.004028 * S**3)
    enhancement = 1.00062 + 3.14e-8 * pressure_Pa + 5.6e-7 * temperature_degC**2
    xv = enhancement * vapour_Pa / pressure_Pa
    molar = _molar_density(temperature_degC, pressure_Pa, xv)
    # The molar masses of dry air and water cancel: densities count relative to those of the standard conditions.
    air = molar * (1 - xv) / _molar_density(15.0, 101325.0, 0.0)
    water = molar * xv / _molar_density(20.0, 1333.0, 1.0)
    return air * axs + water * vs


def _molar_density(t: float, p: float, xv: float) -> float:
    """mol/m^3 of moist air, xv its mole fraction of water: BIPM 1981/91 compressibility (Ciddor, equation 12)."""
    T = t + KELVIN
    dry = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t**2
    moist = (5.707e-6 - 2.051e-8 * t) * xv + (1.9898e-4 - 2.376e-6 * t) * xv**2
    compressibility = 1 - p / T * (dry + moist) + (p / T) ** 2 * (1.83e-11 - 0.765e-8 * xv**2)
    return p / (compressibility * _GAS_J_per_mol_K * T)


Float = NDArray[np.float64]


def shift_mm(radius_mm: Float | float, distance_mm: float, interface_mm: float, n1: float, n2: float) -> Float:
    """How much further out the ray arrives, mm, for radii of any shape; negative when n1 < n2 (warm camera)."""
    tangent = np.asarray(radius_mm, dtype=np.float64) / distance_mm
    sine = n1 / n2 * tangent / np.sqrt(1 + tangent**2)
    return (distance_mm - interface_mm) * (sine / np.sqrt(1 - sine**2) - tangent)


def tilted_shift_mm(tilt_rad: float, distance_mm: float, interface_mm: float, n1: float, n2: float) -> float:
    """The common shift of the whole image by an interface that is turned by tilt_rad: what it does to the axis."""
    return (distance_mm - interface_mm) * float(np.tan(tilt_rad - np.arcsin(n1 / n2 * np.sin(tilt_rad))))


def appears_px(
    offset_px: Float, focal_px: float, distance_mm: float, interface_mm: float, n1: float, n2: float
) -> Float:
    """How far an image point (..., 2), px from the principal point, is moved: outwards when the camera's air is warm.

    The ray that reaches the target's point left at a smaller radius by `shift_mm`, to first order in it.
    """
    radius_px = np.linalg.norm(offset_px, axis=-1, keepdims=True)
    radius_mm = radius_px / focal_px * distance_mm
    moved_px = -shift_mm(radius_mm, distance_mm, interface_mm, n1, n2) / distance_mm * focal_px
    return offset_px * moved_px / np.where(radius_px > 0, radius_px, 1.0)
