"""The guard's table: which rules, how long each must object, and what is then done."""

from __future__ import annotations

from experiments.steps import Capture
from stand.config import StandConfig
from stand.guarding.interlocks import (
    Watch,
    disagreement,
    flap_open,
    frames_stopped,
    over_temperature,
    permit_missing,
    reported_fault,
    stage_alarm,
    stopped_while_permitted,
    trustworthy,
)
from stand.guarding.plausibility import (
    HeatingLimits,
    OffLimits,
    VainLimits,
    cooling_in_vain,
    heater_not_warming,
    stuck,
    stuck_while_other_moves,
    warming_while_off,
)
from stand.hub import Event, Item, StepMark, StepState

PV, AIR, GRANITE, LABORATORY = (
    "regulator.pv",
    "thermometers.air",
    "thermometers.granite_inside",
    "thermometers.laboratory",
)
RUNNING, PERMIT, COMPRESSOR = "regulator.running", "relays.heater_enable", "relays.compressor"
FLAP = "flap.position"


class Announcements:
    """What is said on the hub besides readings and matters to a rule: subscribe `receive`.

    is_capturing: a Capture has begun and not ended. frames_stopped: why the recorder takes no frames, "" while it does.
    """

    def __init__(self) -> None:
        self.is_capturing = False
        self.frames_stopped = ""

    def receive(self, item: Item) -> None:
        """The hub's subscriber."""
        if isinstance(item, StepMark) and item.kind == Capture.__name__:
            self.is_capturing = item.state is StepState.STARTED
        elif isinstance(item, Event) and item.kind in ("frames_stopped", "frames_resumed"):
            self.frames_stopped = item.text if item.kind == "frames_stopped" else ""


def watches(config: StandConfig, announced: Announcements) -> tuple[Watch, ...]:
    """Every rule with the configured limits. Abort where the stand's temperature is not known or not controlled: that
    ends a night. Hold where an operator can put it right and the night is worth going on with."""
    return (*_temperatures(config), *_heat(config), *_sensors(config), *_operations(config, announced))


def _temperatures(config: StandConfig) -> tuple[Watch, ...]:
    """What must never be, at once. The camera's own temperature is limited but not required: it is off before a
    warm-up."""
    limits = config.guard
    return (
        Watch(over_temperature(PV, limits.max_air_degC)),
        Watch(over_temperature(AIR, limits.max_air_degC)),
        Watch(over_temperature(GRANITE, limits.max_granite_degC)),
        Watch(over_temperature("camera.temperature", limits.max_camera_degC)),
        *(Watch(trustworthy(channel, limits.stale_after_s)) for channel in (PV, AIR, GRANITE)),
    )


def _heat(config: StandConfig) -> tuple[Watch, ...]:
    """Heat that does not come, comes unasked, or is held back. The first may be a detached sensor, the second is out
    of control; a relay that does not close or answer, or a compressor that does not cool, can be put right."""
    limits = config.guard
    heating, heater_off = HeatingLimits(**limits.heating.model_dump()), OffLimits(**limits.heater_off.model_dump())
    vain = VainLimits(**limits.cooling.model_dump())
    return (
        Watch(heater_not_warming(heating, "regulator", PERMIT)),
        Watch(warming_while_off(heater_off, AIR, "regulator", PERMIT, (LABORATORY, GRANITE))),
        Watch(cooling_in_vain(vain, AIR, "regulator", COMPRESSOR, (LABORATORY, GRANITE)), action="hold"),
        Watch(permit_missing(RUNNING, PERMIT), 2 * limits.keys_s, "hold"),
        Watch(trustworthy(PERMIT, limits.keys_s), 2 * limits.keys_s, "hold"),
    )


def _sensors(config: StandConfig) -> tuple[Watch, ...]:
    """Of two sensors that disagree nobody knows which is wrong. A thermometer without noise is suspicious, no more."""
    limits = config.guard.sensors
    return (
        Watch(disagreement(PV, AIR, limits.warn_K), limits.warn_after_s, "warn"),
        Watch(disagreement(PV, AIR, limits.trip_K), limits.trip_after_s),
        Watch(stuck_while_other_moves(PV, AIR, limits.air_moves_K, limits.pv_stuck_after_s), action="hold"),
        *(
            Watch(stuck(f"thermometers.{name}", limits.stuck_after_s), action="warn")
            for name in config.thermometers.channels
        ),
    )


def _operations(config: StandConfig, announced: Announcements) -> tuple[Watch, ...]:
    """Hands on the regulator's keys, a stage's alarm, a flap that is open or cannot be asked, a full disk: an operator
    has to come.

    A flap that stays open is closed by making safe; when it does not close, that is an error event of its own.
    """
    limits = config.guard
    return (
        Watch(reported_fault("regulator.fault"), limits.keys_s, "hold"),
        Watch(stopped_while_permitted(RUNNING, PERMIT), limits.keys_s, "hold"),
        *(Watch(stage_alarm(f"{name}.position"), action="hold") for name in config.axes),
        Watch(flap_open(FLAP, lambda: announced.is_capturing), limits.flap_open_s, "hold"),
        Watch(flap_open(FLAP), limits.flap_capture_s, "hold"),
        Watch(trustworthy(FLAP, limits.flap_open_s), limits.flap_open_s, "hold"),
        Watch(frames_stopped(lambda: announced.frames_stopped), limits.disk_low_s, "hold"),
    )
