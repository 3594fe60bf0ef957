"""With what a session was recorded, as far as it says so itself: exposure, gain, devices of the stand's file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from thermostand.compensation.datasheet.measurement_details import MeasurementDetails
from thermostand.foundation.documents import parse_yaml
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import DEVICE_IDENTITY
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session

NOT_STATED = "not stated"
Line = tuple[str, str]
_DEVICES = (
    ("regulator", "Temperature controller"),
    ("heat_module", "Heat output"),
    ("climate_chamber", "Climate chamber"),
    ("thermometer_module", "Thermometer module"),
    ("pt100", "Thermometers"),
)


def list_equipment(session: Session) -> list[Line]:
    """Names and what belongs to them; only what is known."""
    identities = [*_list_identities(session)]
    return [*_list_exposure(session), *identities, *_list_stand_devices(session, are_named=bool(identities))]


def _list_identities(session: Session) -> Iterator[Line]:
    """Return what each device, or its register map, last stated about it; the camera of these frames comes first."""
    found: dict[str, dict[str, Any]] = {}
    for event in session.events():
        if event.kind == DEVICE_IDENTITY:
            found[str(event.data["device"])] = dict(event.data)
    own = found.pop(session.camera, None)
    if own is not None:
        yield "Camera", _format_identity(own)
        if own.get("lens"):
            yield "Lens in the stand's file", str(own["lens"])
    for name, data in found.items():
        if "lens" not in data:  # else it is another camera
            yield f"Device {name.replace('_', ' ')}", _format_identity(data)


def _format_identity(data: dict[str, Any]) -> str:
    facts = (
        " ".join(str(data[key]) for key in ("vendor", "model") if data.get(key)),
        f"serial number {data['serial_number']}" if data.get("serial_number") else "",
        f"version {data['version']}" if data.get("version") else "",
    )
    return ", ".join(text for text in facts if text)


def _list_exposure(session: Session) -> Iterator[Line]:
    metas = session.frame_metas()
    if not metas:
        return
    exposures = sorted({meta.exposure_s for meta in metas if meta.exposure_s > 0})
    if exposures:
        yield "Exposure", _format_range(1e3 * exposures[0], 1e3 * exposures[-1], "ms")
    gains = sorted({meta.gain_dB for meta in metas if meta.gain_dB == meta.gain_dB})
    if gains:
        yield "Gain", _format_range(gains[0], gains[-1], "dB")


def _format_range(low: float, high: float, unit: str) -> str:
    return f"{low:g} {unit}" if low == high else f"{low:g} to {high:g} {unit}"


def _list_stand_devices(session: Session, *, are_named: bool) -> Iterator[Line]:
    """are_named: whether the devices have stated what they are; else it is taken from the stand's file."""
    text = session.attachment("config.yaml")
    try:
        data: Any = parse_yaml(text or "", "config.yaml")
    except ConfigError:
        return
    if not isinstance(data, dict):
        return
    if data.get("name"):
        yield "Stand", str(data["name"])
    for key, name in () if are_named else _DEVICES:
        device = data.get(key)
        if isinstance(device, dict):
            kind = device.get("registers") or device.get("protocol") or device.get("kind") or "of the stand's file"
            yield name, str(kind)
    thermometers = data.get("thermometers")
    if isinstance(thermometers, dict):
        yield "Thermometer channels", ", ".join(_describe_sensor(name, sensor) for name, sensor in thermometers.items())


def _describe_sensor(name: object, sensor: Any) -> str:
    """A sensor with what is known of its calibration, as the stand's file states it."""
    known = sensor if isinstance(sensor, dict) else {}
    certificate = " of ".join(str(known[key]) for key in ("certificate", "calibrated") if known.get(key))
    uncertainty = f"U = {known['uncertainty_K']:g} K" if isinstance(known.get("uncertainty_K"), int | float) else ""
    role = str(known.get("role") or "")
    facts = ", ".join(text for text in (role, certificate, uncertainty) if text)
    return f"{name} ({facts})" if facts else str(name)


def list_stated_details(details: MeasurementDetails, target: Target) -> list[Line]:
    """Return what somebody has stated, and which of what a reader asks for nobody has."""
    distance = "" if details.working_distance_mm is None else f"target {details.working_distance_mm:g} mm away"
    rows = [
        ("Lens", ", ".join(text for text in (details.lens, details.aperture, distance) if text)),
        ("Mount", details.mount),
        ("Target", _describe_target(target)),
        ("Target certificate", details.target_certificate),
        ("Thermometer certificate", details.thermometer_certificate),
        (
            "Thermometers' uncertainty",
            f"air near the camera {details.u_air_K:g} K, standard uncertainty with its place, "
            f"{'as stated' if details.states_u_air else 'assumed'}",
        ),
        ("Places of the sensors", "; ".join(f"{name}: {place}" for name, place in details.sensor_positions.items())),
    ]
    if details.laboratory:
        rows.append(("Laboratory", details.laboratory))
    if details.note:
        rows.append(("Note", details.note))
    return [(name, text or NOT_STATED) for name, text in rows]


def _describe_target(target: Target) -> str:
    discs = f"{target.columns} x {target.rows} discs of {target.diameter_mm:g} mm, {target.pitch_mm:g} mm apart"
    text = f"{target.name}: {discs}"
    if target.cmm_mm is None:
        return f"{text}; nominal coordinates, printing error {1e3 * target.printing_error_mm:g} µm assumed"
    return f"{text}; coordinates measured, standard uncertainty {1e3 * target.cmm_uncertainty_mm:g} µm"
