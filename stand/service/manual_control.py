"""What an operator may tell the devices between runs, and how: through the same interlock as the steps of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from pydantic import JsonValue

from thermostand.drivers.devices import kinds
from thermostand.drivers.devices.cameras.cameras_by_protocol import LONGEST_EXPOSURE_S
from thermostand.drivers.devices.kinds import Verb, Work
from thermostand.experiments.steps import MoveTo, SetTemperature, Step, number_steps
from thermostand.foundation.errors import ConfigError, DeviceError
from thermostand.foundation.items import Batch
from thermostand.stand.assembly.assemble import Assembly
from thermostand.stand.config.interface_section import Role
from thermostand.stand.estimating.estimate import price_plan
from thermostand.stand.serving.api_models import Argument, Conflict, DeviceState, DeviceVerb, Missing


class ManualControl:
    """The verbs of each device, as its kind states them. heat: raises Conflict when heat may not be permitted now."""

    def __init__(self, assembly: Assembly, heat: Callable[[], None]) -> None:
        self._assembly = assembly
        self._stand = assembly.stand
        self._heat = heat
        self._equipment = {each.name: each for each in assembly.equipment if each.poll_s is not None}

    @property
    def doing(self) -> str:
        """What is done between runs, in a few words."""
        ordered = self._stand.chamber.ordered
        return "idle" if ordered is None else f"heat by hand, set-point {ordered.setpoint_degC:g} degC"

    def devices(self, refused: str) -> tuple[DeviceState, ...]:
        """Return what there is; refused: why nothing is taken now."""
        readings = self._assembly.hub.readings
        return tuple(
            DeviceState(
                name=name,
                kind=kind.name,
                channels=tuple(channel for channel in readings if channel.startswith(f"{name}.")),
                verbs=tuple(_make_verb(verb, self._list_arguments(name, verb)) for verb in kind.verbs),
                refused=refused,
            )
            for name, kind, _ in self._equipment.values()
        )

    def work(self, name: str, verb: str, arguments: Mapping[str, JsonValue]) -> Work:
        """Return what is to be done; Missing when there is no such device or verb, ConfigError for what it is given,
        Conflict when the stand cannot do it now."""
        if name not in self._equipment:
            raise Missing(f"this stand has no device of that name; there are {', '.join(self._equipment)}")
        verbs = {each.name: each for each in self._equipment[name].kind.verbs}
        if verb not in verbs:
            raise Missing(f"{name} does not know that; it takes {', '.join(verbs) or 'no orders'}")
        takes = {each.name: each for each in self._list_arguments(name, verbs[verb])}
        if unknown := sorted(set(arguments) - set(takes)):
            raise ConfigError(f"{name} {verb} has no {', '.join(unknown)}; it takes {', '.join(takes) or 'nothing'}")
        given = {each.name: _parse_number(arguments.get(each.name, each.default), each.name) for each in takes.values()}
        return verbs[verb].act(self, name, given)

    def _list_arguments(self, name: str, verb: Verb) -> tuple[kinds.VerbNumber, ...]:
        return verb.arguments(self._equipment[name].settings, partial(getattr, self._assembly.config))

    # As drivers.devices.kinds.Hands.

    def device(self, name: str) -> Any:
        """Get the device once the interlock has nothing against it."""
        self._stand.interlock.check()
        return self._stand.devices.every[name]

    def heat(self, degC: float) -> Work:
        """ConfigError outside the stand's limits."""
        self._check(SetTemperature(degC))
        self._heat()
        chamber = self._stand.chamber
        return chamber.set_temperature(degC) if chamber.permits.is_granted else chamber.start(degC)

    def stop_heat(self) -> Work:
        """Cold as well."""
        return self._stand.chamber.stop()

    def move_flap(self, *, is_open: bool) -> Work:
        """Confirmed."""
        return self._stand.imaging.open_flap() if is_open else self._stand.imaging.close_flap()

    def move_axis(self, name: str, position: float) -> Work:
        """ConfigError outside the axis' limits."""
        self._check(MoveTo(name, position))
        return self._run_then_read(name, self._stand.table.move_to(name, position))

    def stop_axis(self, name: str) -> Work:
        """Stop the axis where it is."""
        return self._run_then_read(name, self._stand.table.stop(name))

    def home_axis(self, name: str) -> Work:
        """Home the axis and report how far its scale was off."""
        return self._run_then_read(name, self._stand.table.check_home(name))

    def supply_cameras(self, *, is_on: bool) -> Work:
        """Switch the supply of all cameras."""
        supply = self._stand.imaging.supply
        return supply.switch_on() if is_on else supply.switch_off()

    def take_frame(self, exposure_s: float) -> Work:
        """ConfigError for an exposure that is none, Conflict without supply."""
        if not 0 < exposure_s <= LONGEST_EXPOSURE_S:
            raise ConfigError(f"exposure_s: above 0 and at most {LONGEST_EXPOSURE_S:g} s, not {exposure_s:g}")
        if not self._stand.imaging.supply.is_on:
            raise Conflict("the camera is off; switch it on first")
        return self._stand.imaging.take_frame(exposure_s, "")

    async def _run_then_read(self, axis: str, work: Work) -> None:
        """Run an order, then read the stage: who waits for its end sees where it is, not where it was when it was
        polled last."""
        await work
        with suppress(DeviceError):  # the poller reports
            readings = await self._stand.devices.axes[axis].read()
            self._assembly.hub.publish(Batch(axis, self._assembly.clock.now_ns(), readings))

    def _check(self, step: Step) -> None:
        """ConfigError outside the stand's limits."""
        price_plan(number_steps([step]), self._assembly.config)


def _make_verb(verb: Verb, takes: Iterable[kinds.VerbNumber]) -> DeviceVerb:
    """Make the verb as it is published."""
    arguments = (Argument(name=name, unit=unit, minimum=low, maximum=high) for name, unit, low, high, _ in takes)
    role: Role = "commission" if verb.heats else "operate"
    return DeviceVerb(verb=verb.name, text=verb.text, role=role, arguments=tuple(arguments))


def _parse_number(value: object, name: str) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ConfigError(f"{name}: a number is needed")
    return float(value)
