"""The index of air against published values: NIST's tables and each equation's own."""

from __future__ import annotations

import pytest

from thermostand.compensation.budget.budget import KELVIN, Index, ciddor_1996, edlen_1966, saturation_Pa


def birch_downs_1994(temperature_degC: float, pressure_Pa: float, vapour_Pa: float, wavelength_um: float) -> float:
    """n - 1 by K. P. Birch and M. J. Downs, Metrologia 31 (1994) 315: NIST's modified Edlen equation."""
    S, t = wavelength_um**-2, temperature_degC
    standard = (8342.54 + 2406147 / (130 - S) + 15998 / (38.9 - S)) * 1e-8
    density = pressure_Pa / 96095.43 * (1 + 1e-8 * (0.601 - 0.00972 * t) * pressure_Pa) / (1 + 0.003661 * t)
    return standard * density - 1e-10 * (292.75 / (t + KELVIN)) * (3.7345 - 0.0401 * S) * vapour_Pa


EQUATIONS = (edlen_1966, birch_downs_1994, ciddor_1996)
DRY_550_nm = {
    -10: (3.04296, 3.04306, 3.04329),
    10: (2.82745, 2.82756, 2.82759),
    22: (2.71217, 2.71227, 2.71229),
    24: (2.69386, 2.69397, 2.69399),
    40: (2.55580, 2.55592, 2.55600),
    52: (2.46118, 2.46130, 2.46148),
    54: (2.44609, 2.44620, 2.44640),
    70: (2.33165, 2.33178, 2.33215),
}


@pytest.mark.parametrize("degC", DRY_550_nm)
def test_dry_air_at_550_nm(degC: float):
    found = tuple(1e4 * equation(degC, 101325.0, 0.0, 0.55) for equation in EQUATIONS)
    assert found == pytest.approx(DRY_550_nm[int(degC)], abs=6e-6)


@pytest.mark.parametrize(
    ("equation", "dry", "half_saturated"),
    [
        (edlen_1966, 2.717882e-4, 2.712963e-4),
        (birch_downs_1994, 2.717990e-4, 2.713745e-4),
        (ciddor_1996, 2.717998e-4, 2.713727e-4),
    ],
)
def test_dry_and_half_saturated_air_at_633_nm(equation: Index, dry: float, half_saturated: float):
    assert equation(20.0, 101325.0, 0.0, 0.633) == pytest.approx(dry, abs=6e-11)
    assert equation(20.0, 101325.0, 0.5 * saturation_Pa(20.0), 0.633) == pytest.approx(half_saturated, abs=6e-11)


@pytest.mark.parametrize(("degC", "pascal"), [(26.85, 3536.58941), (226.85, 2638897.76), (0.01, 611.657)])
def test_saturation_pressure_agrees_with_the_iapws_tables(degC: float, pascal: float):
    assert saturation_Pa(degC) == pytest.approx(pascal, rel=1e-5)


def test_heat_pressure_and_humidity_move_the_index_as_known():
    at = ciddor_1996(24.0, 101325.0, 0.0, 0.55)
    assert ciddor_1996(25.0, 101325.0, 0.0, 0.55) - at == pytest.approx(-9.1e-7, rel=0.01)
    assert ciddor_1996(24.0, 101425.0, 0.0, 0.55) - at == pytest.approx(2.7e-7, rel=0.02)
    assert ciddor_1996(24.0, 101325.0, 0.5 * saturation_Pa(24.0), 0.55) - at == pytest.approx(-5.3e-7, rel=0.03)
