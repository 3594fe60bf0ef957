"""What a plan can show of a camera that was touched."""

from __future__ import annotations

import pytest

from thermostand.experiments.detectability import Detectability, estimate_detectability
from thermostand.experiments.steps import Capture, Role, number_steps


def captures(*set_points_degC: float, role: Role = Role.FIT) -> Detectability | None:
    return estimate_detectability(number_steps(Capture(5, 0.5, 0.1, role, degC) for degC in set_points_degC))


def test_many_looks_show_a_twentieth_of_a_pixel_and_few_less() -> None:
    many, some, few = captures(*range(10, 24)), captures(*range(10, 18)), captures(24, 31, 38, 45, 52)
    assert many == Detectability(14, 0.05)
    assert some == Detectability(8, 0.3)
    assert few == Detectability(5, None)
    assert str(many).startswith("14 looks")
    assert "50 mpx" in str(many)
    assert "too few to tell" in str(few)


@pytest.mark.parametrize("role", [Role.WARM_UP, Role.CALIBRATION, Role.SETTLING])
def test_other_looks_do_not_count(role: Role) -> None:
    assert captures(24, 31, 24, role=role) is None
