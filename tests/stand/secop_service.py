"""A stand behind a SECoP node, without devices: what is ordered is done as far as the test says."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from pathlib import Path

from tests.addresses import find_free_port
from tests.stand.fake_service import FakeService, serve_fake
from thermostand.foundation.errors import DeviceFault, Refused, Unreachable
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.service.stand_service import DeviceRequest
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api_models import (
    Argument,
    Conflict,
    DeviceState,
    DeviceVerb,
    Requester,
    StandState,
)
from thermostand.stand.serving.secop import make_secop_listener

AT = Argument(name="position", unit="mm", minimum=0, maximum=280)
WARM = Argument(name="setpoint_degC", unit="degC", minimum=-10, maximum=60)
FOR = Argument(name="exposure_s", unit="s", minimum=0, maximum=10)
PLAIN = tuple[str, ...]


class SecopService(FakeService):
    """The chamber reaches a set-point when the test says `air_degC`, the stage and the flap at once, unless they are
    `slow`. `fails`: what a device answers."""

    def __init__(self) -> None:
        super().__init__()
        self.air_degC = 24.0
        self.setpoint_degC: float | None = None
        self.linear_mm = 0.0
        self.flap = "closed"
        self.phase = "idle"
        self.busy: tuple[str, ...] = ()
        self.is_slow = False
        self.fails: Exception | None = None
        self.poll()

    def poll(self) -> None:
        """All is read."""
        now_ns, setpoint_degC = self.clock.now_ns(), self.setpoint_degC
        chamber = {"pv": self.air_degC, "sp": setpoint_degC or 0.0, "running": float(setpoint_degC is not None)}
        self.hub.publish(
            Batch("regulator", now_ns, tuple(Reading(f"regulator.{n}", v, "degC", now_ns) for n, v in chamber.items()))
        )
        self.hub.publish(Batch("linear", now_ns, (Reading("linear.position", self.linear_mm, "mm", now_ns),)))
        self.hub.publish(Batch("flap", now_ns, (Reading("flap.position", float(self.flap == "open"), "1", now_ns),)))
        self.hub.publish(Batch("camera", now_ns, (Reading("camera.temperature", 38.5, "degC", now_ns),)))
        self.hub.publish(self.batch(self.air_degC))

    def lose(self, channel: str) -> None:
        """It cannot be read any more."""
        now_ns = self.clock.now_ns()
        self.hub.publish(Batch("x", now_ns, (bad_reading(channel, "degC", now_ns, "no answer within 0.5 s", "wire"),)))

    def state(self) -> StandState:
        state = super().state()
        given = self.hub.readings
        readings = {
            name: each.model_copy(update={"reason": given[name].reason, "cause": given[name].cause})
            for name, each in state.readings.items()
        }
        return state.model_copy(
            update={
                "readings": readings,
                "setpoint_degC": self.setpoint_degC,
                "axes": {"linear": self.linear_mm},
                "flap": self.flap,
                "phase": self.phase,
                "busy": self.busy,
            }
        )

    def devices(self) -> tuple[DeviceState, ...]:
        thermometers = tuple(name for name in self.hub.readings if name.startswith("thermometers."))
        return (
            _device("regulator", "regulator", ("regulator.pv",), _verb("set", WARM), _verb("stop")),
            _device("relays", "relays", ("relays.compressor",)),
            _device("thermometers", "thermometers", thermometers),
            _device("flap", "flap", ("flap.position",), _verb("open"), _verb("close")),
            _device("linear", "axis", ("linear.position",), _verb("move", AT), _verb("stop"), _verb("home")),
            _device("camera", "camera", ("camera.temperature",), _verb("on"), _verb("off"), _verb("frame", FOR)),
        )

    async def device(self, who: Requester, given: DeviceRequest) -> str:
        name, verb, arguments = given.device, given.verb, given.arguments
        if self.phase != "idle":
            raise Conflict("a run has the stand; `stand stop` ends it")
        if self.fails is not None:
            raise Conflict(str(self.fails)) from self.fails
        match name, verb:
            case "regulator", "set":
                self.setpoint_degC = float(str(arguments["setpoint_degC"]))
            case "regulator", "stop":
                self.setpoint_degC = None
            case "linear", "move":
                await self._moved(float(str(arguments["position"])))
            case "flap", _:
                self.flap = "open" if verb == "open" else "closed"
            case _:
                pass
        return ""

    async def _moved(self, position_mm: float) -> None:
        if self.is_slow:
            self.busy = ("linear",)
            await asyncio.sleep(0.05)
        self.linear_mm = position_mm


def _verb(verb: str, *arguments: Argument) -> DeviceVerb:
    return DeviceVerb(verb=verb, text=verb, arguments=arguments)


def _device(name: str, kind: str, channels: tuple[str, ...], *verbs: DeviceVerb) -> DeviceState:
    return DeviceState(name=name, kind=kind, channels=channels, verbs=verbs)


WIRE = Unreachable("linear", "no answer within 0.5 s")
JAM = DeviceFault("linear", "stopped at a limit switch")
NO = Refused("linear", "300 mm is outside the limits")


@contextlib.asynccontextmanager
async def node(desk: FakeService, folder: Path) -> AsyncGenerator[int]:
    """The port at which the desk answers SECoP while inside."""
    port = find_free_port()
    async with serve_fake(desk, folder / "cycle", Interface(folder, doors=(make_secop_listener(port),))):
        yield port
