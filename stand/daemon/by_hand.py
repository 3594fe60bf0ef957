"""What an operator may tell the devices between runs, and how: through the same interlock as the steps of a run."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import dataclass

from pydantic import JsonValue

from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulator
from thermostand.experiments.steps import MoveTo, SetTemperature, Step, number_steps
from thermostand.foundation.errors import ConfigError, DeviceError
from thermostand.foundation.items import Batch
from thermostand.stand.assembly import Assembly, device_kinds
from thermostand.stand.estimating.estimate import price
from thermostand.stand.serving.desk import Argument, Conflict, DeviceState, DeviceVerb, Missing

Work = Coroutine[None, None, object]
Arguments = Mapping[str, JsonValue]

_LONGEST_EXPOSURE_S = 10.0


@dataclass(frozen=True, slots=True)
class _Verb:
    """What is published of it, and what it does with a device of that name."""

    described: DeviceVerb
    work: Callable[[str, Arguments], Work]


class ByHand:
    """The verbs of each device. heat: raises Conflict when heat may not be permitted now."""

    def __init__(self, assembly: Assembly, heat: Callable[[], None]) -> None:
        self._assembly = assembly
        self._stand = assembly.stand
        self._heat = heat
        self._kinds = device_kinds(assembly.config)

    @property
    def doing(self) -> str:
        """What is done between runs, in a few words."""
        ordered = self._stand.chamber.ordered
        return "idle" if ordered is None else f"heat by hand, set-point {ordered.setpoint_degC:g} degC"

    def devices(self, refused: str) -> tuple[DeviceState, ...]:
        """What there is; refused: why nothing is taken now."""
        readings = self._assembly.hub.readings
        return tuple(
            DeviceState(
                name=name,
                kind=kind,
                channels=tuple(channel for channel in readings if channel.startswith(f"{name}.")),
                verbs=tuple(verb.described for verb in self._verbs(name).values()),
                refused=refused,
            )
            for name, kind in self._kinds.items()
        )

    def work(self, name: str, verb: str, arguments: Arguments) -> Work:
        """What is to be done; Missing when there is no such device or verb, ConfigError for what it is given, Conflict
        when the stand cannot do it now."""
        if name not in self._kinds:
            raise Missing(f"this stand has no device of that name; there are {', '.join(self._kinds)}")
        verbs = self._verbs(name)
        if verb not in verbs:
            raise Missing(f"{name} does not know that; it takes {', '.join(verbs) or 'no orders'}")
        known = {argument.name for argument in verbs[verb].described.arguments}
        if unknown := sorted(set(arguments) - known):
            raise ConfigError(f"{name} {verb} has no {', '.join(unknown)}; it takes {', '.join(known) or 'nothing'}")
        return verbs[verb].work(name, arguments)

    def _verbs(self, name: str) -> dict[str, _Verb]:
        kind = self._kinds[name]
        table = {
            "regulator": self._of_regulator,
            "flap": self._of_flap,
            "axis": lambda: self._of_axis(name),
            "camera": self._of_camera,
        }
        verbs = table[kind]() if kind in table else ()
        return {verb.described.verb: verb for verb in verbs}

    def _of_regulator(self) -> tuple[_Verb, ...]:
        low, high = self._assembly.config.limits.chamber_degC
        setpoint = Argument(name="setpoint_degC", unit="degC", minimum=low, maximum=high)
        verbs = (
            _Verb(DeviceVerb(verb="set", text="heat or cool to a set-point", arguments=(setpoint,)), self._set),
            _Verb(DeviceVerb(verb="stop", text="stop heating and cooling"), _simply(self._stand.chamber.stop)),
        )
        if not isinstance(self._stand.devices.regulator, SoftwareRegulator):
            return verbs
        text = "find the constants of its law about a set-point, once that is held"
        return (*verbs, _Verb(DeviceVerb(verb="autotune", text=text, arguments=(setpoint,)), self._autotune))

    def _of_flap(self) -> tuple[_Verb, ...]:
        imaging = self._stand.imaging
        return (
            _Verb(DeviceVerb(verb="open", text="open the flap"), _simply(imaging.open_flap)),
            _Verb(DeviceVerb(verb="close", text="close the flap"), _simply(imaging.close_flap)),
        )

    def _of_axis(self, name: str) -> tuple[_Verb, ...]:
        settings = self._assembly.config.axes[name]
        low, high = settings.limits
        position = Argument(name="position", unit=settings.unit, minimum=low, maximum=high)
        return (
            _Verb(DeviceVerb(verb="move", text="move to a position", arguments=(position,)), self._move),
            _Verb(DeviceVerb(verb="stop", text="stop where it is"), self._stop),
            _Verb(DeviceVerb(verb="home", text="find the home switch"), self._home),
        )

    def _of_camera(self) -> tuple[_Verb, ...]:
        supply = self._stand.imaging.supply
        exposure = Argument(name="exposure_s", unit="s", minimum=0.0, maximum=_LONGEST_EXPOSURE_S)
        return (
            _Verb(DeviceVerb(verb="on", text="switch the supply of all cameras on"), _simply(supply.switch_on)),
            _Verb(DeviceVerb(verb="off", text="switch the supply of all cameras off"), _simply(supply.switch_off)),
            _Verb(DeviceVerb(verb="frame", text="take one frame", arguments=(exposure,)), self._frame),
        )

    def _set(self, _: str, arguments: Arguments) -> Work:
        setpoint_degC = _number(arguments, "setpoint_degC")
        self._check(SetTemperature(setpoint_degC))
        self._heat()
        chamber = self._stand.chamber
        return chamber.set_temperature(setpoint_degC) if chamber.permits.granted else chamber.start(setpoint_degC)

    async def _autotune(self, name: str, arguments: Arguments) -> None:
        await self._set(name, arguments)
        if isinstance(regulator := self._stand.devices.regulator, SoftwareRegulator):
            await regulator.autotune()

    def _move(self, axis: str, arguments: Arguments) -> Work:
        position = _number(arguments, "position")
        self._check(MoveTo(axis, position))
        return self._then_read(axis, self._stand.table.move_to(axis, position))

    def _stop(self, axis: str, _: Arguments) -> Work:
        return self._then_read(axis, self._stand.table.stop(axis))

    def _home(self, axis: str, _: Arguments) -> Work:
        return self._then_read(axis, self._stand.table.check_home(axis))

    async def _then_read(self, axis: str, work: Work) -> None:
        """Who waits for the end of an order sees where the stage is, not where it was when it was polled last."""
        await work
        with suppress(DeviceError):  # the poller tells
            readings = await self._stand.devices.axes[axis].read()
            self._assembly.hub.publish(Batch(axis, self._assembly.clock.now_ns(), readings))

    def _frame(self, name: str, arguments: Arguments) -> Work:
        exposure_s = _number(arguments, "exposure_s", self._assembly.config.cameras[name].exposure_s)
        if not 0 < exposure_s <= _LONGEST_EXPOSURE_S:
            raise ConfigError(f"exposure_s: above 0 and at most {_LONGEST_EXPOSURE_S:g} s, not {exposure_s:g}")
        if not self._stand.imaging.supply.is_on:
            raise Conflict("the camera is off; switch it on first")
        return self._stand.imaging.take_frame(exposure_s, "")

    def _check(self, step: Step) -> None:
        """ConfigError outside the stand's limits."""
        price(number_steps([step]), self._assembly.config)


def _simply(work: Callable[[], Work]) -> Callable[[str, Arguments], Work]:
    """Of a verb that needs no arguments."""

    def made(_name: str, _arguments: Arguments) -> Work:
        return work()

    return made


def _number(arguments: Arguments, name: str, default: float | None = None) -> float:
    value = arguments.get(name, default)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ConfigError(f"{name}: a number is needed")
    return float(value)
