"""The whole memory of a run, as a value: what is done, soaked and recorded, and what has been undone since.

It is folded from the run's entries (fold.py); what to do next is read from it
(stand/running/executing/actions.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, field, replace
from itertools import chain
from types import MappingProxyType

from thermostand.experiments.steps import (
    AnySoak,
    Capture,
    CloseFlap,
    MoveTo,
    OpenFlap,
    PlannedStep,
    PowerCamera,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    StopChamber,
)
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.stand.running.memory.entries import Change, Edited, Ended

# Ids of steps, as an immutable set to which one is added quickly: a plan may have 100,000 steps.


class Ids(Set[str]):
    """Disjoint parts, each larger than the one behind it, as the digits of a binary counter: adding copies an id about
    log2(n) times over a whole run, where a frozenset would copy all of them each time."""

    __slots__ = ("_parts",)

    def __init__(self, ids: Iterable[str] = ()) -> None:
        first = frozenset(ids)
        self._parts: tuple[frozenset[str], ...] = (first,) if first else ()

    def __contains__(self, step_id: object) -> bool:
        return any(step_id in part for part in self._parts)

    def __iter__(self) -> Iterator[str]:
        return chain.from_iterable(self._parts)

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def __repr__(self) -> str:
        return f"Ids({sorted(self)})"

    def plus(self, step_id: str) -> Ids:
        """Return the set with this one added."""
        if step_id in self:
            return self
        parts, last = list(self._parts), frozenset((step_id,))
        while parts and len(parts[-1]) <= len(last):
            last |= parts.pop()
        more = Ids()
        more._parts = (*parts, last)
        return more

    def minus(self, gone: Set[str]) -> Ids:
        """Return the set without those given."""
        return Ids(step_id for step_id in self if step_id not in gone)


Plan = tuple[PlannedStep, ...]


def _make_empty() -> Mapping[str, int]:
    return MappingProxyType({})


@dataclass(frozen=True, slots=True)
class SetUp:
    """What steps have set up, so that it can be brought about again: of each kind only the last counts.

    chamber_degC: the set-point, None when the chamber is stopped. positions: axis -> mm or deg. soaks: the soaks since
    the last set-point, which count only as long as the chamber stays at it. others: the last step of each kind that
    another package adds. Before any step the camera is on and the flap closed."""

    chamber_degC: float | None = None
    soaks: Plan = ()
    camera_on: bool = True
    flap_open: bool = False
    positions: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    others: Mapping[str, PlannedStep] = field(default_factory=lambda: MappingProxyType({}))

    def after(self, planned: PlannedStep) -> SetUp:
        """Return what it is when that step, too, is done."""
        match planned.step:
            case StartChamber(chamber_degC) | SetTemperature(chamber_degC):
                return replace(self, chamber_degC=chamber_degC, soaks=())
            case StopChamber():
                return replace(self, chamber_degC=None, soaks=())
            case Soak() | SoakUntilSettled():
                return replace(self, soaks=(*self.soaks, planned))
            case PowerCamera(on):
                return replace(self, camera_on=on)
            case OpenFlap():
                return replace(self, flap_open=True)
            case CloseFlap():
                return replace(self, flap_open=False)
            case MoveTo(axis, position):
                return replace(self, positions=MappingProxyType({**self.positions, axis: position}))
            case step if step.is_setup:
                return replace(self, others=MappingProxyType({**self.others, step.kind: planned}))
            case _:
                return self

    @property
    def text(self) -> str:
        """The set-up in words, as in `chamber at 30 degC, camera on, flap open, linear at 2`."""
        parts = [f"camera {'on' if self.camera_on else 'off'}", f"flap {'open' if self.flap_open else 'closed'}"]
        parts += [f"{axis} at {position:g}" for axis, position in self.positions.items()]
        parts += [planned.step.words for planned in self.others.values()]
        chamber = "stopped" if self.chamber_degC is None else f"at {self.chamber_degC:g} degC"
        return f"chamber {chamber}, {', '.join(parts)}"


@dataclass(frozen=True, slots=True)
class RunState:
    """plan: in force, that is with all changes. index: the place of the first step that is not done, len(plan) when all
    are; set_up: by the steps before it.

    done, begun, skipped: ids of steps; what is skipped counts as done. under_way: the id of the step that was begun by
    this daemon and is not done, "" when there is none. earned_ns: of soaks, by id; one that is done and not listed has
    lasted its whole time. soaked: by the same, how they ended, where that is recorded. frames: by the id of a capture
    that is not done. taken_again: by the same, how often because the disk had lost some of them. changes: of the
    plan, as they came.

    disturbances: how often something may have undone the set-up (an interlock, a camera that was off, a daemon's death,
    a warm-up that is restarted), of which so many are `restored`. is_cold: the camera was or may have been off, and the
    soaks have not been taken back yet.

    reasons: what holds the run. readying: the stand is being made ready. out_ns: for how long either was so since the
    camera was last seen (its last frame, or when the plan switched it), with out_since_ns the present time of it.
    seen_ns: that instant. was_held: since then. due_ns: of the next frame; is_lost: the camera did not give the last.

    tripped: why an operator has to look first, "" when nothing tripped. ended: how the run last ended, None while it
    runs.
    """

    plan: Plan
    index: int = 0
    set_up: SetUp = field(default_factory=SetUp)
    done: Ids = field(default_factory=Ids)
    begun: Ids = field(default_factory=Ids)
    skipped: Ids = field(default_factory=Ids)
    under_way: str = ""
    soaked_ns: Mapping[str, int] = field(default_factory=_make_empty)
    soaked: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    frames: Mapping[str, int] = field(default_factory=_make_empty)
    retakes: Mapping[str, int] = field(default_factory=_make_empty)
    changes: tuple[Change, ...] = ()
    setup_invalidations: int = 0
    restored: int = 0
    is_cold: bool = False
    reasons: frozenset[str] = frozenset()
    readying: bool = False
    out_ns: int = 0
    out_since_ns: int | None = None
    seen_ns: int = 0
    was_held: bool = False
    due_ns: int | None = None
    is_lost: bool = False
    tripped: str = ""
    ended: Ended | None = None

    def is_decided(self, step_id: str) -> bool:
        """Return whether the decision of that step was made; it is not made again."""
        return any(isinstance(change, Edited) and change.decided == step_id for change in self.changes)

    @property
    def is_setup_invalid(self) -> bool:
        """Whether the set-up has to be brought about again."""
        return self.setup_invalidations > self.restored

    @property
    def soaked_s(self) -> dict[str, float]:
        """The soak time so far in s (see soaked_ns)."""
        return {step_id: soaked_ns / NS_PER_S for step_id, soaked_ns in self.soaked_ns.items()}

    @property
    def size(self) -> dict[str, object]:
        """How many steps and frames the plan in force has, for the recording: without what is left out."""
        steps = sum(planned.step_id not in self.skipped for planned in self.plan)
        captures = ((each.step_id, each.step) for each in self.plan if isinstance(each.step, Capture))
        frames = sum(self.frames.get(each, 0) if each in self.skipped else step.frames for each, step in captures)
        return {"steps": steps, "frames": frames}

    @property
    def frames_to_come(self) -> bool:
        """Whether a capture of the plan is not done."""
        return any(isinstance(each.step, Capture) and each.step_id not in self.done for each in self.plan[self.index :])

    @property
    def is_unsettled(self) -> bool:
        """Whether the last guaranteed soak at the present set-point ended without the chamber in its band, or all of
        them were left out."""
        soaks = list(self._iterate_soaks())
        done = (each.step_id for each, _ in soaks if each.step_id not in self.skipped)
        return bool(soaks) and self.soaked.get(next(done, ""), "unsettled") == "unsettled"

    @property
    def band_K(self) -> float | None:
        """The band of the last guaranteed soak at the present set-point that was not left out; None when there is
        none."""
        return next((band_K for each, band_K in self._iterate_soaks() if each.step_id not in self.skipped), None)

    def _iterate_soaks(self) -> Iterator[tuple[PlannedStep, float]]:
        """The guaranteed soaks at the present set-point with their bands, K; the last one first."""
        for planned in reversed(self.plan[: self.index]):
            if isinstance(planned.step, AnySoak) and planned.step.guaranteed_K > 0.0:
                yield planned, planned.step.guaranteed_K
            elif isinstance(planned.step, StartChamber | SetTemperature | StopChamber) and (
                planned.step_id not in self.skipped
            ):
                return

    def step(self, step_id: str) -> PlannedStep | None:
        """The step of that id in the plan in force."""
        if self.index < len(self.plan) and self.plan[self.index].step_id == step_id:
            return self.plan[self.index]
        return next((planned for planned in self.plan if planned.step_id == step_id), None)

    def remaining_ns(self, soak: PlannedStep) -> int:
        """Return how much of its longest time the soak has still to go; nothing when it has ended, or is left out."""
        if soak.step_id in self.soaked or soak.step_id in self.skipped:
            return 0
        duration_ns = get_duration_ns(soak)
        soaked_ns = self.soaked_ns.get(soak.step_id, duration_ns if soak.step_id in self.done else 0)
        return max(0, duration_ns - soaked_ns)

    def outage_ns(self, now_ns: int) -> int:
        """Return how long the run stood still since the camera was last seen."""
        return self.out_ns + (0 if self.out_since_ns is None else now_ns - self.out_since_ns)


def get_duration_ns(soak: PlannedStep) -> int:
    """Return what the soak takes at the most, ns; 0 when it is no soak."""
    return to_ns(soak.step.longest_s) if isinstance(soak.step, AnySoak) else 0
