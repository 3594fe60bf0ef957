"""What a report says of the devices that measured."""

from types import SimpleNamespace
from typing import Any

import pytest

from thermostand.compensation.reporting.equipment import equipment_of
from thermostand.foundation.items import Event


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
    session: Any = SimpleNamespace(
        frame_metas=list[Any], camera="camera", events=list[Any], attachment={"config.yaml": config}.get
    )
    assert ("Thermometer channels", f"{text}, laboratory") in equipment_of(session)


def test_devices_stand_with_what_they_said_of_themselves_and_other_cameras_do_not() -> None:
    cameras = [
        identity("camera", "Basler", "a2A", "40001", lens="25 mm"),
        identity("left", "Basler", "a2A", "7", lens=""),
    ]
    events = [
        *cameras,
        identity("relays", "Waveshare", "Relay (8)", ""),
        identity("relays", "Waveshare", "Relay (16)", ""),
    ]
    session: Any = SimpleNamespace(frame_metas=list[Any], camera="camera", events=lambda: events, attachment={}.get)
    assert equipment_of(session) == [
        ("Camera", "Basler a2A, serial number 40001, version 1"),
        ("Lens in the stand's file", "25 mm"),
        ("Device relays", "Waveshare Relay (16), version 1"),
    ]


def identity(device: str, vendor: str, model: str, serial: str, **more: str) -> Event:
    data = {"device": device, "vendor": vendor, "model": model, "serial_number": serial, "version": "1", **more}
    return Event(0, "info", "device_identity", "", data)
