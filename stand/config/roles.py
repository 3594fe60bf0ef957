"""Whether the thermometers of a stand have the roles that its rules need."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from thermostand.drivers.devices.thermometers import PLACES, Role, ThermometerSettings, by_channel

GUARDED: tuple[Role, ...] = ("air",)  # without which nothing is heated


def witnesses(thermometers: Mapping[str, ThermometerSettings], controlling: str = "") -> list[str]:
    """The thermometers by which the guard finds that the regulator's probe and the air's are wrong alike: the granite
    inside, which follows the air, and safety ones; not the one that `controlling` names."""
    sensors = by_channel(thermometers)
    return [
        name for name, each in sensors.items() if (name == "granite_inside" or each.is_safety) and name != controlling
    ]


def unfit_roles(thermometers: Mapping[str, ThermometerSettings]) -> Iterator[str]:
    """A sentence for each role that nobody has, that two have, or that another name belies."""
    places = [each.role or name for name, each in thermometers.items()]
    for place in PLACES:
        if places.count(place) > 1:
            yield f"thermometers: two of them have the role {place}; one place is one thermometer's"
    for name, each in thermometers.items():
        if name in PLACES and each.role not in (None, name):
            yield f"thermometers.{name} has the role {each.role}; give it another name, or the role {name}"
    if missing := [place for place in GUARDED if place not in by_channel(thermometers)]:
        yield (
            f"thermometers lacks {', '.join(missing)}, without which nothing is heated; name one so, or give one "
            f"`role: {missing[0]}`"
        )
