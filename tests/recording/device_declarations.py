"""What devices of the usual kinds are recorded to measure."""

from collections.abc import Mapping

from thermostand.foundation.readings import Channel
from thermostand.recording.format.batches import BatchSchema, RecordedDevice, make_batch_schema

PLACES = ("granite_inside", "granite_outside", "artifact", "air", "laboratory")
_CHANNELS: Mapping[str, tuple[tuple[str, str], ...]] = {
    "thermometers": (*((place, "degC") for place in PLACES), *((f"{place}_raw", "1") for place in PLACES)),
    "regulator": (("pv", "degC"), ("sp", "degC"), ("running", "1"), ("fault", "1"), ("mv_heat", "%"), ("mv_cool", "%")),
    "relays": tuple((name, "1") for name in ("heater_enable", "compressor", "camera_power")),
    "camera": (("temperature", "degC"),),
    "axis": (("position", "mm"), ("moving", "1"), ("homed", "1")),
    "flap": (("position", "1"), ("current", "mA")),
    "imager": (("lens", "degC"), ("housing", "degC"), ("back", "degC"), ("clock_offset", "s")),
}
_KINDS = {"position": "position"}
KINDS = tuple(_CHANNELS)


def declare_devices(devices: Mapping[str, str]) -> dict[str, RecordedDevice]:
    """Devices by their names, of kinds by their names; an axis named rotary is in degrees."""
    return {name: _device(name, kind) for name, kind in devices.items()}


def form(name: str, kind: str = "") -> BatchSchema:
    """How the readings of a device are recorded, which is named as its kind unless that is given."""
    return make_batch_schema(name, _device(name, kind or name))


def _device(name: str, kind: str) -> RecordedDevice:
    units = {"mm": "deg"} if name == "rotary" else {}
    channels = (Channel(each, units.get(unit, unit), _KINDS.get(each, "")) for each, unit in _CHANNELS[kind])
    return RecordedDevice(kind, tuple(channels), is_opened=kind != "camera")
