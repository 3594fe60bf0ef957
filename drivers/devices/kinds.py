"""What a kind of device states of itself, once. The stand derives from it how one is made, locked, opened, polled,
checked, moved by hand, recorded and simulated.

Each driver module has its row, `KIND`, which `load_built_in_kinds` finds. Another package adds one by an entry
point of the group `thermostand.devices`, named as the kind, which is the row itself; a stand's file has such devices by
their names below `devices:`, each with its `kind` and what that kind's settings ask for.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple, Protocol, cast

import thermostand.drivers.devices
from thermostand.drivers.devices.device_check import DeviceCheck, check_answers
from thermostand.drivers.devices.protocols import Sensor
from thermostand.drivers.settings import OnBus
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.clock import Clock
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError, DeviceError, Unreachable
from thermostand.foundation.items import Item
from thermostand.foundation.plugins import check_settings, load_row
from thermostand.foundation.readings import Channel, Reading

_CHANNEL_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,39}")
GROUP = "thermostand.devices"
ADDED = "devices"  # the section of a stand's file for kinds that are named there
Work = Coroutine[None, None, object]
Arguments = Mapping[str, float]
OfSection = Callable[[str], Any]  # what a section of the stand's file has
MapOf = Callable[[str, OnBus], RegisterMap]  # of a unit, named in that section; ConfigError when missing or wrong
Declared = Callable[[Any, OfSection, MapOf], Iterable[Channel]]  # of its settings; None for what is in its place


@dataclass(frozen=True, slots=True)
class DriverContext:
    """What a driver may use of the stand that its device is made for. made: the devices before it, by name. known: the
    last reading of a channel. of_section: what another section of the stand's file has. map_of: the register map of a
    unit, named in that section; ConfigError when it is missing or wrong."""

    clock: Clock
    bus: Bus
    made: Mapping[str, Sensor]
    publish: Callable[[Item], None]
    known: Callable[[str], Reading | None]
    of_section: OfSection
    map_of: MapOf


class LockedPlace(NamedTuple):
    """A place where a device is found, which no two runs may use at once. wire: a serial or TCP address; host: of what
    answers at one; number: what a real device is known by wherever it is; name: as it is."""

    how: Literal["wire", "host", "number", "name"]
    text: str


class VerbNumber(NamedTuple):
    """A number that a verb takes, with its unit and bounds; the default is for one that is not given."""

    name: str
    unit: str = "1"
    minimum: float | None = None
    maximum: float | None = None
    default: float | None = None


class ManualActions(Protocol):
    """What the stand does for the verbs of its devices, through gate, interlock and limits, as for a step of a run. All
    raise what those raise."""

    def device(self, name: str) -> Any:
        """The device of that name, when something may be done with it now."""
        ...

    def heat(self, degC: float) -> Work:
        """Heat or cool to a set-point."""
        ...

    def stop_heat(self) -> Work:
        """Stop heating and cooling."""
        ...

    def move_flap(self, *, is_open: bool) -> Work:
        """Open or shut the flap."""
        ...

    def move_axis(self, name: str, position: float) -> Work:
        """Move a stage."""
        ...

    def stop_axis(self, name: str) -> Work:
        """Stop a stage where it is."""
        ...

    def home_axis(self, name: str) -> Work:
        """Find a stage's home switch."""
        ...

    def supply_cameras(self, *, is_on: bool) -> Work:
        """Switch the supply of all cameras."""
        ...

    def take_frame(self, exposure_s: float) -> Work:
        """One frame of each camera."""
        ...


@dataclass(frozen=True, slots=True)
class Verb:
    """What a person may tell a device between runs. heats: only who commissions the stand may."""

    name: str
    text: str
    act: Callable[[ManualActions, str, Arguments], Work]
    arguments: Callable[[Any, OfSection], tuple[VerbNumber, ...]] = lambda settings, of_section: ()
    heats: bool = False


def _list_set_points(settings: object, of_section: OfSection) -> tuple[VerbNumber, ...]:
    return (VerbNumber("setpoint_degC", "degC", *of_section("limits").chamber_degC),)


CONTROLLED = (
    Channel("pv", "degC", "temperature"),
    Channel("sp", "degC", "temperature"),
    Channel("running", "1", "flag"),
    Channel("fault", "1", "flag"),
)
"""What every controller of the chamber's temperature reports."""
CONTROL = (
    Verb(
        "set",
        "heat or cool to a set-point",
        lambda stand, _, given: stand.heat(given["setpoint_degC"]),
        _list_set_points,
        heats=True,
    ),
    Verb("stop", "stop heating and cooling", lambda stand, name, given: stand.stop_heat()),
)
"""What a person may tell whatever holds the chamber's temperature."""


class Absence(NamedTuple):
    """What a stand has not, and what follows from that; as a text both, in a sentence."""

    what: str
    means: str

    def __str__(self) -> str:
        return f"no {self.what}: {self.means}"


def _list_places(settings: Any) -> Iterable[LockedPlace]:
    """List the device's address, if it has one of its own."""
    address = getattr(settings, "address", None)
    return () if address is None else (LockedPlace("wire", address),)


def _advise(error: DeviceError, name: str, settings: Any) -> str:
    if isinstance(error, Unreachable):
        return "is it plugged in and on, and its address right? `stand devices` lists the ports"
    return f"compare {name} in the stand's file with the device"


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceKind:
    """One row. name: as the device is shown. settings: its keys in the stand's file. make: the device, not opened.

    channels: what it measures, or what says so of its settings, of other sections and of register maps.
    section: where the stand's file has it; device: its name, where there is only one. rank: the order in which devices
    are made, opened, polled and checked. is_opened: with the stand, else by what uses it. places: what is locked.
    address_key: the setting that says where it answers, "" for a unit on the bus. stand_in: what is in its place on a
    stand without one, which is polled each stand_in_s, None for not at all. missing: what such a stand lacks. advise:
    what a person does about an error. check: what `stand check` looks at. verbs: what a person may tell it.
    simulated_map: of a unit on the bus, the register map of the one in the simulated laboratory.
    fakes: by what the simulated laboratory has it, one for each protocol; its section (the name of an added kind) by
    default, () for none.
    """

    name: str
    settings: type[Document]
    make: Callable[[str, Any, DriverContext], Sensor]
    channels: tuple[Channel, ...] | Declared = ()
    section: str = ADDED
    device: str = ""
    rank: int = 85
    is_opened: bool = True
    places: Callable[[Any], Iterable[LockedPlace]] = _list_places
    address_key: str = "address"
    stand_in: Callable[[str, Clock], Sensor] | None = None
    stand_in_s: float | None = None
    missing: Absence | None = None
    advise: Callable[[DeviceError, str, Any], str] = _advise
    check: Callable[[DeviceCheck], Coroutine[None, None, None]] = check_answers
    verbs: tuple[Verb, ...] = ()
    simulated_map: str = ""
    fakes: tuple[str, ...] | None = None

    def fake(self, settings: Any) -> str:
        """The kind by which the simulated laboratory has it; "" where it has nothing of it."""
        fakes = (self.section if self.section != ADDED else self.name,) if self.fakes is None else self.fakes
        of_protocol = f"{self.section}.{getattr(settings, 'protocol', '')}"
        return of_protocol if of_protocol in fakes else next(iter(fakes), "")


def _explain_channel_name(name: str, names: Sequence[str]) -> str:
    """Return why readings cannot be found by that name among these; "" when they can."""
    if not _CHANNEL_NAME.fullmatch(name):
        return "and a channel's name is of letters, digits and _, a letter first, at most 40; correct the package"
    return "twice; a channel has one name and one unit: correct the package" if names.count(name) > 1 else ""


class Equipment(NamedTuple):
    """One device of a stand; settings: None for what is in the place of one that it lacks."""

    name: str
    kind: DeviceKind
    settings: Any

    @property
    def poll_s(self) -> float | None:
        """How often it is read; None for never."""
        return self.kind.stand_in_s if self.settings is None else self.settings.poll_s

    def channels(self, of_section: OfSection, map_of: MapOf) -> tuple[Channel, ...]:
        """Return what it measures; ConfigError when it declares what cannot be recorded under its name."""
        declared = self.kind.channels
        found = declared if isinstance(declared, tuple) else (*declared(self.settings, of_section, map_of),)
        names = [each.name for each in found]
        for each in found:
            if fault := _explain_channel_name(each.name, names):
                raise ConfigError(f"{self.name}: its kind {self.kind.name} declares the channel {each.name!r}, {fault}")
        return found

    def made(self, around: DriverContext) -> Sensor:
        """The device, or what is in its place; not opened."""
        if self.settings is None and self.kind.stand_in is not None:
            return self.kind.stand_in(self.name, around.clock)
        return self.kind.make(self.name, self.settings, around)


@cache
def load_built_in_kinds() -> tuple[DeviceKind, ...]:
    """The rows of the modules in drivers/devices, in the order of their ranks."""
    found: list[DeviceKind] = []
    root = thermostand.drivers.devices
    for module in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
        known = vars(importlib.import_module(module.name))
        found += cast("tuple[DeviceKind, ...]", known.get("KINDS", (known["KIND"],) if "KIND" in known else ()))
    return tuple(sorted(found, key=lambda kind: kind.rank))


def load_kind(name: str) -> DeviceKind:
    """The kind of that name without a section of its own, ours or another package's; ConfigError when there is none, or
    it cannot be loaded."""
    if ours := next((kind for kind in load_built_in_kinds() if (kind.name, kind.section) == (name, ADDED)), None):
        return ours
    kind = load_row(GROUP, name, DeviceKind, "a device of kind")
    if kind.section != ADDED:
        raise ConfigError(
            f"{name}: its DeviceKind has the section {kind.section!r} of another kind; correct the package"
        )
    return kind


def load_settings(data: object) -> object:
    """The settings of a device of another package, by its `kind`; ValueError for what they do not take."""
    if not isinstance(data, dict):
        return data
    keys = cast("dict[str, object]", data)
    try:
        kind = load_kind(str(keys.get("kind", "")))
    except ConfigError as error:
        raise ValueError(str(error)) from error
    return check_settings(kind.settings, keys)


def list_equipment(config: object, added: Mapping[str, Any]) -> tuple[Equipment, ...]:
    """Every device that a stand's file has, in the order of their ranks, with stand-ins for those that it lacks. added:
    those of other packages, by name."""
    found = [Equipment(name, load_kind(settings.kind), settings) for name, settings in added.items()]
    for kind in (each for each in load_built_in_kinds() if each.section != ADDED):
        section = getattr(config, kind.section)
        named = cast("Mapping[str, Any]", {kind.device: section} if kind.device else section)
        found += [Equipment(name, kind, each) for name, each in named.items() if isinstance(each, kind.settings)]
        if section is None and kind.stand_in is not None:
            found.append(Equipment(kind.device, kind, None))
    return tuple(sorted(found, key=lambda each: each.kind.rank))
