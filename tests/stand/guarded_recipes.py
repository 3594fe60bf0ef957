"""The installed recipes as what they do to a chamber, minute by minute, and what interrupts a session."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from tests.stand.guarded_chamber import Action, Chamber
from thermostand.experiments.steps import (
    Capture,
    CloseFlap,
    KnownStand,
    OpenFlap,
    PowerCamera,
    SetTemperature,
    Situation,
    SoakUntilSettled,
    StartChamber,
    Step,
    StopChamber,
)
from thermostand.foundation.documents import load_document
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import find_packaged

RECIPES = (
    "calibration",
    "demo",
    "overnight",
    "thermal-cycle",
    "thermal-cycle-settled",
    "validation",
    "warm-up",
)
BOOT_S = 4.0
SETTLED_SHARE = 0.6  # of the longest dwell, when a camera settles
EVERY_S = 7000.0  # an interruption


@dataclass
class Player:
    """A recipe's steps as actions on a chamber. With `interrupted` something comes between them every EVERY_S, in turn:
    a hold that is reset by itself, a pause, a camera that was off for a minute."""

    recipe: str
    interrupted: bool
    set_point_degC: float | None = None

    def actions(self) -> Iterator[tuple[float, Action]]:
        """How long each lasts, s, and what it does."""
        begun_s, interruptions = 0.0, 0
        for planned in load_document(find_packaged("recipes", self.recipe), Recipe).plan():
            last_s = 0.0
            for last_s, action in self._perform(planned.step):
                yield last_s, action
                begun_s += last_s
            if self.interrupted and begun_s >= EVERY_S and self.set_point_degC is not None and last_s > 60:
                begun_s = 0.0
                yield from self._interruption(interruptions % 3)
                interruptions += 1

    def _perform(self, step: Step) -> Iterator[tuple[float, Action]]:
        stand = KnownStand()
        stand.boot_s = BOOT_S
        duration_s = step.price(Situation(flap_open=isinstance(step, CloseFlap)), stand).duration_s
        match step:
            case StartChamber(degC):
                self.set_point_degC = degC
                yield duration_s, lambda chamber: chamber.start(degC)
            case SetTemperature(degC):
                self.set_point_degC = degC
                yield duration_s, lambda chamber: chamber.set_temperature(degC)
            case StopChamber():
                self.set_point_degC = None
                yield duration_s, Chamber.stop
            case OpenFlap() | CloseFlap():
                yield duration_s, _flap(1.0 if isinstance(step, OpenFlap) else 0.0)
            case PowerCamera(on):
                yield duration_s, _power(on)
            case SoakUntilSettled():
                looks = int(step.max_s * SETTLED_SHARE / step.look_every_s)
                for _ in range(looks):
                    yield step.look_every_s - 10.0, _flap(0.0)
                    yield 10.0, _flap(1.0)
                yield 0.0, _flap(0.0)
            case Capture():
                yield duration_s, _nothing
            case _:
                yield duration_s, _nothing

    def _interruption(self, kind: int) -> Iterator[tuple[float, Action]]:
        set_point_degC = self.set_point_degC or 24.0
        if kind == 0:
            yield 180.0, Chamber.stop
            yield 1800.0, lambda chamber: chamber.start(set_point_degC)
        elif kind == 1:
            yield 3600.0, _nothing
        else:
            yield 60.0, _power(False)
            yield 600.0, _power(True)


def _flap(openness: float) -> Action:
    def action(chamber: Chamber) -> None:
        chamber.flap_open = openness

    return action


def _power(on: bool) -> Action:
    def action(chamber: Chamber) -> None:
        chamber.plant.camera_powered = on

    return action


def _nothing(chamber: Chamber) -> None: ...
