"""What each kind of device measures, and the topic and fields that its readings are recorded in.

Field numbers follow the order of the tables below. They are the file format: append, never reorder.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity of a device ("device.name" in `unit`) and the field that carries it."""

    name: str
    unit: str
    field: str


@dataclass(frozen=True, slots=True)
class Kind:
    """What a kind of device measures, and where that is recorded."""

    topic: str
    schema: str
    quantities: tuple[Quantity, ...]


THERMOMETERS = ("granite_inside", "granite_outside", "artifact", "air", "laboratory")
KINDS: Mapping[str, Kind] = {
    "thermometers": Kind(
        "/sensors/temperature",
        "Temperatures",
        (
            *(Quantity(place, "degC", f"{place}_degC") for place in THERMOMETERS),
            *(Quantity(f"{place}_raw", "1", f"{place}_raw") for place in THERMOMETERS),
        ),
    ),
    "regulator": Kind(
        "/chamber/state",
        "ChamberState",
        (
            Quantity("pv", "degC", "actual_degC"),
            Quantity("sp", "degC", "set_point_degC"),
            Quantity("mv_heat", "%", "heating_percent"),
            Quantity("mv_cool", "%", "cooling_percent"),
            Quantity("running", "1", "running"),
            Quantity("fault", "1", "fault"),
        ),
    ),
    "relays": Kind(
        "/relays/state",
        "RelayState",
        tuple(Quantity(relay, "1", relay) for relay in ("heater_enable", "compressor", "camera_power")),
    ),
    "camera": Kind("/camera/temperature", "Temperature", (Quantity("temperature", "degC", "temperature_degC"),)),
    "axis": Kind(
        "/table/state",
        "TableState",
        (
            Quantity("position", "mm", "position_mm"),
            Quantity("position", "deg", "position_deg"),
            Quantity("moving", "1", "moving"),
            Quantity("homed", "1", "homed"),
        ),
    ),
    "flap": Kind(
        "/flap/state",
        "FlapState",
        (Quantity("position", "1", "position"), Quantity("current", "mA", "current_mA")),
    ),
    "imager": Kind(
        "/imager/state",
        "ImagerState",
        (
            *(Quantity(spot, "degC", f"{spot}_degC") for spot in ("lens", "housing", "back")),
            Quantity("clock_offset", "s", "clock_offset_s"),
        ),
    ),
    "output": Kind(
        "/heat/output", "HeatOutput", (Quantity("output", "mA", "output_mA"), Quantity("tripped", "1", "tripped"))
    ),
}
KIND_OF_TOPIC = {kind.topic: kind for kind in KINDS.values()}
