"""What a report says of the devices that measured."""

from types import SimpleNamespace
from typing import Any

import pytest

from compensation.reporting.equipment import equipment_of


@pytest.mark.parametrize(
    ("sensor", "text"),
    [
        ("{channel: 3}", "air"),
        ("{channel: 3, certificate: T-17}", "air (T-17)"),
        (
            "{channel: 3, certificate: T-17, calibrated: 2026-03-11, uncertainty_K: 0.02}",
            "air (T-17 of 2026-03-11, U = 0.02 K)",
        ),
        ("{channel: 3, uncertainty_K: 0.1}", "air (U = 0.1 K)"),
        ("3", "air"),
    ],
)
def test_a_sensor_stands_with_its_certificate_and_uncertainty(sensor: str, text: str) -> None:
    config = f"thermometers: {{air: {sensor}, laboratory: {{channel: 4}}}}"
    session: Any = SimpleNamespace(frame_metas=[], attachment={"config.yaml": config}.get)
    assert ("Thermometer channels", f"{text}, laboratory") in equipment_of(session)
