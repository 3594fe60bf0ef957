"""The camera's own temperature, without which no frame is of use: there before the first step, and while frames are to
come."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

from drivers.devices.camera import Camera
from experiments.steps import Capture, PlannedStep
from foundation.clock import Clock, seconds_ns
from foundation.errors import Refused
from foundation.hub import Hub
from foundation.items import Event, Item, StepMark, StepState
from foundation.readings import Quality

_TRIES, _PAUSE_S = 3, 1.0


async def check_temperature(camera: Camera, hub: Hub, clock: Clock, *, has_temperature: bool) -> None:
    """The camera, which is open, shows its temperature, or is configured to have none, which is told.

    Refused, with the feature and what the camera offers, when three readings in a row are BAD.
    """
    if not has_temperature:
        text = "the camera is configured to have no temperature: no drift over it can be fitted to this session"
        hub.publish(Event(clock.now_ns(), "warning", "no_camera_temperature", text))
        return
    (reading,) = await camera.read()
    for _ in range(_TRIES - 1):
        if reading.quality is not Quality.BAD:
            return
        await clock.sleep_until(clock.now_ns() + seconds_ns(_PAUSE_S))
        (reading,) = await camera.read()
    if reading.quality is Quality.BAD:
        place = await camera.temperature_place()
        remedy = "correct camera.temperature in the configuration, or say camera.has_temperature: false there"
        where = f" ({place})" if place else ""
        raise Refused(camera.name, f"its temperature is BAD before the first step: {reading.reason}{where}; {remedy}")


class FramesToCome:
    """Whether the camera is powered and a capture of the plan is not done; a subscriber of the hub."""

    def __init__(self, is_powered: Callable[[], bool], plan: Iterable[PlannedStep], done: Collection[str]) -> None:
        self._is_powered = is_powered
        self._captures = {planned.step_id for planned in plan if isinstance(planned.step, Capture)} - set(done)

    def __call__(self, item: Item) -> None:
        """Follow the captures; one that is done again counts again."""
        if isinstance(item, StepMark) and item.kind == Capture.__name__:
            change = self._captures.discard if item.state is StepState.DONE else self._captures.add
            change(item.step_id)

    def is_due(self) -> bool:
        """For the guard's rule."""
        return self._is_powered() and bool(self._captures)
