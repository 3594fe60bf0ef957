"""Pauses, interlocks, faults, stops, kills and time in any order: what a dwell has earned is neither lost nor counted
twice, no step is done twice, and a stop makes safe before anything unwinds and ends the run from wherever it is."""

import itertools
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase as HPhase
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.stand.small_stand import Life
from thermostand.experiments.steps import (
    Capture,
    CloseFlap,
    OpenFlap,
    Role,
    SetTemperature,
    Soak,
    StartChamber,
    StopChamber,
    number_steps,
)
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.errors import StandTripped
from thermostand.foundation.items import StepMark, StepState
from thermostand.foundation.readings import Frame
from thermostand.recording.format.journal_lines import parse_lines
from thermostand.stand.running.executing.actions import CREDITED_WITHIN_K
from thermostand.stand.running.memory.entries import Restarted, Soaked, StepChanged, decode
from thermostand.stand.running.memory.journal import JOURNAL_NAME
from thermostand.stand.running.opening.stop import Interrupted
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import CAMERA_LOST, DISK_LOW, INTERLOCK, NOT_RECORDED, OPERATOR, STOPPING, Phase

FRAMES = 4
MEMORY = Path("/dev/shm")  # a journal on a busy disk takes most of the time
PLAN = tuple(
    number_steps(
        [
            CloseFlap(),
            StartChamber(24.0),
            Soak(70.0, band_K=0.0),
            OpenFlap(),
            Capture(FRAMES, 4.0, 0.1, Role.REFERENCE, 24.0),
            CloseFlap(),
            SetTemperature(30.0),
            Soak(62.0, band_K=0.0),
            Soak(7.0, band_K=0.0),
            OpenFlap(),
            Capture(FRAMES, 4.0, 0.1, Role.FIT, 30.0),
            CloseFlap(),
            StopChamber(),
        ]
    )
)
SOAKS_S = {planned.step_id: planned.step.duration_s for planned in PLAN if isinstance(planned.step, Soak)}
HOLDS = (OPERATOR, DISK_LOW, NOT_RECORDED)
# At which set-point a step is, degC, and how long the chamber soaks there before it, s.
PLACES = {}
for _planned in PLAN:
    if isinstance(_planned.step, StartChamber | SetTemperature):
        _place = (_planned.step.chamber_degC, 0.0)
    if isinstance(_planned.step, Soak):
        _place = (_place[0], _place[1] + _planned.step.duration_s)
    PLACES[_planned.step_id] = _place if _planned.index else (24.0, 0.0)

lives = precondition(lambda self: not self.life.run.done())


class RunMachine(RuleBasedStateMachine):
    """One session of several lives; `holding` is what was asked for and not taken back."""

    def __init__(self):
        super().__init__()
        self.folder = tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None)
        self.disk, self.holding = [], set()
        self.read, self.entries = b"", []  # of the journal
        self.life: Any = None
        self.soak: Any = None

    @initialize(steps=st.integers(0, len(PLAN) - 1), late_s=st.sampled_from([0.0, 0.6, 2.0, 6.4]))
    def begin(self, steps, late_s):
        """So many steps are done in peace: what is interesting is not always at the beginning."""
        self._live(0, 24.0)
        while self.life.begun <= steps:
            self.life.passes(0.5)
        self.life.passes(late_s)

    def _live(self, start_ns, chamber_degC):
        self.holding.clear()
        self.set_open_s = 0.0
        self.life = Life(Path(self.folder.name), PLAN, start_ns, self.disk, chamber_degC)
        self.life.hub.subscribe(self._on_item)

    def teardown(self):
        if self.life is not None:
            self.life.kill()
        self.folder.cleanup()

    def _entries(self):
        """Those of the journal's file; what is behind the last look alone is decoded, which is most of the work."""
        data = (Path(self.folder.name) / JOURNAL_NAME).read_bytes()
        if not data.startswith(self.read):
            self.read, self.entries = b"", []
        lines = parse_lines(data)
        self.read = data[: lines.size_bytes]
        self.entries = [*self.entries, *map(decode, lines.sound[len(self.entries) :])]
        return self.entries

    def _frames_that_count(self):
        """Those on the disk that were not superseded."""
        since_ns = {
            step_id: entry.time_ns
            for entry in (self._entries() if self.life is not None else ())
            if isinstance(entry, Restarted)
            for step_id in entry.step_ids
        }
        frames = [item for item in self.disk if isinstance(item, Frame)]
        return [frame for frame in frames if frame.time_ns >= since_ns.get(frame.step_id, 0)]

    # What is seen as it happens.

    def _on_item(self, item):
        if isinstance(item, Frame):
            self._check_frame(item.step_id)
        if isinstance(item, StepMark) and item.kind in ("start_chamber", "set_temperature"):
            self.set_open_s = self.life.open_s()
        if isinstance(item, StepMark) and item.step_id in SOAKS_S:
            self._check_soak(item)

    def _check_frame(self, step_id):
        """The chamber has soaked at the set-point, unless it was found there when it was set going again."""
        chamber_degC, soaked_s = PLACES[step_id]
        stand, now_ns = self.life.stand, self.life.clock.now_ns()
        credited = stand.started_at_degC is not None and abs(stand.started_at_degC - chamber_degC) <= CREDITED_WITHIN_K
        if not credited and (now_ns - stand.set_ns) / NS_PER_S < soaked_s:
            self.life.wrong.append(f"a frame of {step_id} before the chamber had soaked")
        if stand.supplied_ns is not None and (now_ns - stand.supplied_ns) / NS_PER_S < soaked_s:
            self.life.wrong.append(f"a frame of {step_id} before the camera had soaked")

    def _check_soak(self, mark):
        """A soak that no interlock disturbs takes what it owes of the time during which nothing holds it."""
        life = self.life
        if mark.state is StepState.STARTED:
            soaked_s = [e.soaked_s for e in self._entries() if isinstance(e, Soaked) and e.step_id == mark.step_id]
            self.soak = life.open_s() + SOAKS_S[mark.step_id] - (soaked_s[-1] if soaked_s else 0.0), life.disturbances
        if mark.state is StepState.DONE:
            end_s, disturbances = self.soak
            if disturbances == life.disturbances and abs(life.open_s() - end_s) > 1e-6:
                life.wrong.append(f"{mark} at {life.open_s()} instead of {end_s}")
            if disturbances == life.disturbances and (not life.stand.heating or life.stand.flap_open):
                life.wrong.append(f"{mark} in a stand that is not set up")

    # What may happen.

    @lives
    @rule(duration_s=st.sampled_from([0.3, 1.0, 2.5, 10.0, 61.0]))
    def time_passes(self, duration_s):
        self.life.passes(duration_s)

    @precondition(lambda self: not self.life.run.done() and not self.life.stand.gate.reasons)
    @rule(late_s=st.sampled_from([0.0, 0.1, 1.5, 6.0, 30.0]))
    def the_next_step_is_under_way(self, late_s):
        life, begun, tries = self.life, self.life.begun, 200  # a device that fails may keep it from coming
        while not life.run.done() and life.begun == begun and tries:
            life.passes(0.5)
            tries -= 1
        life.passes(late_s)

    @lives
    @rule(reason=st.sampled_from(HOLDS), duration_s=st.sampled_from([0.0, 0.3, 5.0, 90.0]))
    def hold_for_a_while(self, reason, duration_s):
        self.hold(reason)
        self.life.passes(duration_s)
        self.clear(reason)

    @lives
    @rule(reason=st.sampled_from(HOLDS))
    def hold(self, reason):
        self.holding.add(reason)
        self.life.call(lambda: self.life.stand.gate.hold(reason))

    @rule(reason=st.sampled_from(HOLDS))
    def clear(self, reason):
        self.holding.discard(reason)
        self.life.call(lambda: self.life.stand.gate.clear(reason))

    @lives
    @rule(duration_s=st.sampled_from([3.0, 40.0, 90.0]))
    def camera_is_lost(self, duration_s):
        self.life.stand.camera_back_ns = self.life.clock.now_ns() + to_ns(duration_s)

    @precondition(lambda self: not self.life.run.done() and STOPPING not in self.life.stand.gate.reasons)
    @rule(unconfirmed=st.booleans())
    def interlock(self, unconfirmed):
        self.holding.add(INTERLOCK)
        self.life.interlock(unconfirmed)

    @precondition(lambda self: not self.life.run.done() and STOPPING not in self.life.stand.gate.reasons)
    @rule(
        duration_s=st.sampled_from([0.0, 5.0, 90.0]),
        pv_degC=st.sampled_from([24.0, 26.0, 30.0]),
        unconfirmed=st.booleans(),
    )
    def interlock_for_a_while(self, duration_s, pv_degC, unconfirmed):
        self.interlock(unconfirmed)
        self.life.passes(duration_s)
        self.operator_clears(pv_degC)

    @rule(pv_degC=st.sampled_from([24.0, 24.9, 26.0, 30.0]))
    def operator_clears(self, pv_degC):
        self.life.publish_pv(pv_degC)
        self.clear(INTERLOCK)

    @lives
    @rule()
    def camera_loses_its_supply(self):
        self.life.call(self.life.stand.drop_supply)

    @lives
    @rule()
    def device_fails(self):
        self.life.stand.broken = True

    @lives
    @rule(fault=st.sampled_from([None, Fault("over_temperature", "too hot")]), again=st.booleans())
    def stopped(self, fault, again):
        """By the operator or by the guard, perhaps twice."""
        life, calls = self.life, 1 + again
        for _ in range(calls):
            life.call(life.stop if fault is None else lambda: life.trip(fault))
            life.passes(0.4)
        life.passes(5.0)
        assert life.run.done()
        assert isinstance(life.run.exception(), Interrupted if fault is None else StandTripped) or self._is_complete()
        assert life.stop.phase is Phase.ENDED

    @precondition(lambda self: not self._is_complete())
    @rule(downtime_s=st.sampled_from([1.0, 100.0]), pv_degC=st.sampled_from([24.0, 26.0, 30.0]))
    def killed_and_resumed(self, downtime_s, pv_degC):
        self._live(self.life.kill() + to_ns(downtime_s), pv_degC)

    def _is_complete(self):
        return self.life.run.done() and self.life.run.exception() is None

    # What always holds.

    @invariant()
    def nothing_wrong_was_seen(self):
        assert self.life is None or not self.life.wrong

    @invariant()
    def no_reason_to_wait_came_or_went_by_itself(self):
        if self.life is not None:
            assert self.life.stand.gate.reasons - {CAMERA_LOST, STOPPING} == self.holding

    @invariant()
    def no_step_is_done_twice_and_all_come_in_order(self):
        done = [item.step_id for item in self.disk if isinstance(item, StepMark) and item.state is StepState.DONE]
        assert done == [planned.step_id for planned in PLAN[: len(done)]]

    @invariant()
    def a_soak_earns_at_most_the_time_that_passes_and_all_of_its_duration(self):
        soaked_s, last_ns = defaultdict[str, float](float), dict[str, int]()
        for entry in self._entries() if self.life is not None else ():
            if isinstance(entry, Soaked):
                gained_s = entry.soaked_s - soaked_s[entry.step_id]
                assert entry.soaked_s == 0.0 or 0.0 <= gained_s <= 60.0 + 1e-6
                passed_s = (entry.time_ns - last_ns.get(entry.step_id, 0)) / NS_PER_S
                assert entry.soaked_s == 0.0 or gained_s <= passed_s + 1e-6
                soaked_s[entry.step_id], last_ns[entry.step_id] = entry.soaked_s, entry.time_ns
            if isinstance(entry, StepChanged) and entry.state == "done" and entry.step_id in SOAKS_S:
                assert soaked_s[entry.step_id] == SOAKS_S[entry.step_id]

    @invariant()
    def a_capture_that_is_done_has_its_frames(self):
        frames = Counter(frame.step_id for frame in self._frames_that_count())
        done = {item.step_id for item in self.disk if isinstance(item, StepMark) and item.state is StepState.DONE}
        for planned in PLAN:
            if isinstance(planned.step, Capture):
                taken = frames[planned.step_id]
                assert taken == FRAMES if planned.step_id in done else taken <= FRAMES

    @invariant()
    def the_frames_of_a_capture_belong_together(self):
        """But for an interruption of a minute, and what is on the way then."""
        frames = self._frames_that_count()
        for earlier, later in itertools.pairwise(frames):
            assert earlier.step_id != later.step_id or later.time_ns - earlier.time_ns <= 80 * NS_PER_S

    @invariant()
    def the_flap_is_shut_in_a_hold_that_lasts(self):
        if self.life is not None and not self.life.run.done():
            assert not (self.life.held_s() >= 60.0 and self.life.stand.flap_open)

    @invariant()
    def a_run_that_has_ended_heats_nothing_and_was_safe_before_it_unwound(self):
        if self.life is not None and self.life.run.done():
            assert not self.life.stand.heating
            assert not self.life.stand.flap_open
            assert not self.life.cancelled_before_safe


def runs_of(examples: int, *, derandomize: bool) -> settings:
    return settings(
        max_examples=examples, stateful_step_count=25, deadline=None, derandomize=derandomize, phases=[HPhase.generate]
    )


TestRunMachine = RunMachine.TestCase
TestRunMachine.settings = runs_of(40, derandomize=True)


@pytest.mark.nightly
class TestRunMachineNightly(RunMachine.TestCase):
    settings = runs_of(4000, derandomize=False)
