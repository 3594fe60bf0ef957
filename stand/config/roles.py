"""Whether the thermometers of a stand have the roles that its rules need."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from drivers.devices.thermometers import PLACES, Role, ThermometerSettings, by_channel

GUARDED: tuple[Role, ...] = ("air", "granite_inside")  # without which nothing is heated


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
