"""A stand in memory, for the executor alone: a chamber, a flap, a camera and a disk, on a clock that goes on only
while it is led. Each action takes a second; what is not allowed is noted in `wrong`."""

import asyncio
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, cast

from thermostand.drivers.settings import EquilibriumSettings
from thermostand.experiments.steps import Capture
from thermostand.foundation.clock import NS_PER_S, VirtualClock, to_ns
from thermostand.foundation.errors import StandTripped, Unreachable
from thermostand.foundation.events import CAMERA_EQUILIBRIUM_LOST
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.markers.target import Target
from thermostand.stand.assembly.stand import Stand
from thermostand.stand.imaging.equilibrium import CameraEquilibrium
from thermostand.stand.running.executing.camera_gap import OffsetWatch
from thermostand.stand.running.executing.decisions import Decider, keep_fixed_plan
from thermostand.stand.running.executing.executor import Executor, raise_unguarded
from thermostand.stand.running.executing.settling_watch import SettlingWatch
from thermostand.stand.running.memory.entries import Gap
from thermostand.stand.running.memory.fold import fold
from thermostand.stand.running.memory.journal import JOURNAL_NAME, Journal, Logbook
from thermostand.stand.running.opening.holds import keep_flap_closed_in_holds
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.running.resume import merge_recorded
from thermostand.stand.safety.gate import CAMERA_LOST, INTERLOCK, OPERATOR, STOPPING, Gate
from thermostand.stand.safety.interlock import Interlocked
from thermostand.stand.safety.making_safe import Safety

TARGET = Target(name="paper-9x6", columns=9, rows=6, pitch_mm=30, diameter_mm=8)
TIME_CONSTANT_S = 5.0  # of a camera that tells no temperature
NOTHING: Any = None  # the executor never looks at an image
COMMIT_S = 0.2  # what the disk takes to have all that was published
COMMIT_EVERY_S = 1.0  # and what was published before that, it has in any case


class SmallStand:
    """As stand.stand.Stand towards the executor. broken: the next action fails; unconfirmed: the
    next try to make it safe does, as one does that takes more than its real time; camera_back_ns: until then it is
    lost; supplied: whether the camera is. It is its own chamber, imaging, camera supply and table."""

    def __init__(self, clock, hub, wrong):
        self.gate = Gate()
        self.chamber = self.imaging = self.supply = self.table = self
        limits = EquilibriumSettings().model_copy(
            update={"time_constant_s": TIME_CONSTANT_S}
        )  # shorter than any camera's
        self.equilibrium = CameraEquilibrium(limits, hub, clock)
        self.safety = Safety(lambda: None, hub, clock)
        self.safety.take(self)
        self.name = "stand"
        self.supplied, self.supplied_ns = True, None
        self.safe = self.heating = self.flap_open = self.broken = self.unconfirmed = False
        self.camera_back_ns = 0
        self.image: Any = None  # what a look shows
        self.started_at_degC = None  # what the chamber was at when it was last set going, None after a new set-point
        self.set_ns = 0  # when that was
        self._clock, self._hub, self._wrong = clock, hub, wrong

    async def _act(self, what):
        if self.gate.reasons - {CAMERA_LOST, INTERLOCK, STOPPING}:
            self._wrong.append(f"{what} while held by {sorted(self.gate.reasons)}")
        self._check()
        self.safe = False
        await self._clock.sleep_until(self._clock.now_ns() + NS_PER_S)
        self._check()

    def _check(self):
        if STOPPING in self.gate.reasons:
            raise StandTripped("ended")
        if INTERLOCK in self.gate.reasons:
            raise Interlocked("held")
        if self.broken:
            self.broken = False
            raise Unreachable("flap", "unplugged")

    async def start(self, chamber_degC):
        found_degC = self._hub.latest("regulator.pv").value
        await self._act("start_chamber")
        self.heating, self.set_ns, self.started_at_degC = True, self._clock.now_ns(), found_degC

    async def set_temperature(self, chamber_degC):
        await self._act("set_temperature")
        self.started_at_degC, self.set_ns = None, self._clock.now_ns()

    async def stop(self):
        await self._act("stop_chamber")
        self.heating = False

    async def open_flap(self):
        await self._act("open_flap")
        self.flap_open = True

    async def close_flap(self):
        self.flap_open = False

    async def approach_again(self):
        self._check()

    async def take_frame(self, exposure_s, step_id, due_ns, cameras, flags):
        try:
            await self._act("take_frame")
            is_lost = self._clock.now_ns() < self.camera_back_ns or not self.supplied
            while self._clock.now_ns() < self.camera_back_ns and self.supplied:
                self.gate.hold(CAMERA_LOST)
                await self._clock.sleep_until(self._clock.now_ns() + NS_PER_S)
                self._check()
        finally:
            self.gate.clear(CAMERA_LOST)
        if is_lost:
            return False
        if not (self.flap_open and self.heating):
            self._wrong.append("a frame of a stand that is not set up")
        if self.supplied_ns is not None and self._clock.now_ns() < self.supplied_ns + to_ns(5 * TIME_CONSTANT_S):
            self._wrong.append("a frame of a cold camera")
        self._hub.publish(Frame("camera.image", NOTHING, self._clock.now_ns(), exposure_s, 0.0, 40.0, 1, 1, 0, step_id))
        return True

    def drop_supply(self):
        """As the keeper finds it."""
        if self.supplied:
            self.supplied = False
            self.equilibrium.lose("brown-out")

    async def restore(self):
        if not self.supplied:
            await self._act("restore_camera")
            self.supplied, self.supplied_ns = True, self._clock.now_ns()
            self.equilibrium.begin()

    async def look(self, exposure_s, step_id):
        await self.open_flap()
        await self._act("look")
        await self.close_flap()
        frame = Frame("camera.image", self.image, self._clock.now_ns(), exposure_s, 0.0, 40.0, 1, 1, 0, step_id)
        self._hub.publish(frame)
        return frame

    async def cool_down(self, band_K, time_constant_s, max_s):
        self._check()
        await self._clock.sleep_until(self._clock.now_ns() + to_ns(max_s))

    async def prompt(self, text):
        self._check()
        self.gate.hold(OPERATOR)
        await self.gate.wait_until_open()

    async def check_home(self, axis):
        await self._act("check_home")

    async def make_safe(self):
        self.heating = self.flap_open = False
        if self.unconfirmed:
            self.unconfirmed = False
            raise TimeoutError
        await self._clock.sleep_until(self._clock.now_ns() + NS_PER_S)
        self.heating = self.flap_open = False
        self.safe = True


class Life:
    """One daemon, from its start to its death; what it leaves is in `folder`, and what it recorded in `disk`. decides:
    makes the plan's decisions, in a process of its own. follows: the chamber is always at its set-point, and says
    so. gap: that after which it is begun. meet: gets a device error that a step has met. What it publishes is in
    `reported`."""

    def __init__(
        self,
        folder: Path,
        plan,
        start_ns,
        disk,
        chamber_degC,
        decides=None,
        *,
        follows=False,
        gap=None,
        meet=raise_unguarded,
    ):
        self.loop = asyncio.new_event_loop()
        self.wrong = []
        self.hub, self.clock, self.reported = Hub(), VirtualClock(start_ns), []
        self.hub.subscribe(self.reported.append)
        self._decider = Decider(folder, self.clock, decides).decide if decides else keep_fixed_plan
        self.stop = Stop()
        self.stand = SmallStand(self.clock, self.hub, self.wrong)
        self.stand.gate.subscribe(self._on_gate)
        self.hub.subscribe(self._on_item)
        self.begun = 0  # steps
        self.disturbances = 0  # interlocks, and cameras that were off
        self.cancelled_before_safe = False
        self._open_since_ns, self._open_ns, self._closed_ns = start_ns, 0, start_ns
        self._plan, self._journal_path = plan, folder / JOURNAL_NAME
        self._disk, self._unsaved = disk, []
        self._resumes = self._journal_path.exists()
        self._still = ExitStack()  # holds the clock
        self._follows, self._gap, self._meet = follows, gap, meet
        self.publish_pv(chamber_degC)
        self.do(self._begin(folder))

    def trip(self, fault):
        """As the guard does."""
        self.stop.trip(fault)
        self.stand.safety.demand()

    async def _begin(self, folder):
        first, reported = (), ()
        if self._resumes:
            self._journal, entries = Journal.open(folder)
            frames = [(item.time_ns, item.step_id) for item in self._disk if isinstance(item, Frame)]
            captures = {planned.step_id for planned in self._plan if isinstance(planned.step, Capture)}
            reported = merge_recorded(entries, self._disk, [frame for frame in frames if frame[1] in captures])
            last_ns = max([item.time_ns for item in self._disk] + [entry.time_ns for entry in entries], default=0)
            first = (Gap(last_ns, self.clock.now_ns()),)
        else:
            self._journal = Journal.create(folder)
        self.log = Logbook(self.hub, self.clock, fold(self._plan, reported))
        self._time = asyncio.create_task(self.clock.run())
        await self.log.begin(self._journal, *first)
        self.stand.gate.subscribe(self.log.note_hold)
        stand = cast(Stand, self.stand)  # run_stand.py holds the one against the other
        settling = SettlingWatch(stand, self.hub, self.clock, TARGET)
        self.executor = Executor(
            stand,
            self.hub,
            self.clock,
            self.log,
            flushed=self._flushed,
            settling=settling,
            offsets=OffsetWatch(self.hub, self.clock, self._gap),
            decider=self._decider,
            meet=self._meet,
        )
        self._flap = asyncio.create_task(keep_flap_closed_in_holds(stand, self.hub, self.clock))
        self.run = asyncio.create_task(self._run(self.executor))
        if self._follows:
            self._chamber = asyncio.create_task(self._follow())

    async def _run(self, executor):
        """As a guarded run has it."""
        async with self.stop:
            self.stop.watch(cast(Stand, self.stand))
            self.stop.begin()
            try:
                await executor.run()
            except asyncio.CancelledError:
                self.cancelled_before_safe = not self.stand.safe
                raise
            finally:
                self.stop.begin_takedown()
                self.stand.safety.demand()
                await self.stand.safety.wait_until_confirmed(600.0)
                self.stop.end()
                await self.stop.wait_until_aborted()

    async def _flushed(self):
        published = len(self._unsaved)
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(COMMIT_S))
        self._disk.extend(self._unsaved[:published])
        del self._unsaved[:published]

    def do(self, work):
        """Time goes on meanwhile and stands still before and after, or the last turns of the loop would let it jump."""

        async def within():
            self._still.close()
            try:
                return await work
            finally:
                self._still.enter_context(self.clock.hold())

        return self.loop.run_until_complete(within())

    def passes(self, duration_s):
        """Let time go on; whatever is to happen meanwhile happens."""
        self.do(self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s)))

    def call(self, action):
        """`action()` within the daemon."""

        async def work():
            return action()

        return self.do(work())

    def publish_pv(self, pv_degC):
        reading = Reading("regulator.pv", pv_degC, "degC", self.clock.now_ns())
        self.hub.publish(Batch("regulator", self.clock.now_ns(), (reading,)))

    async def _follow(self):
        while not self.run.done():
            set_up = self.log.state.set_up
            self.publish_pv(24.0 if set_up.chamber_degC is None else set_up.chamber_degC)
            await self.clock.sleep_until(self.clock.now_ns() + to_ns(0.5))

    def interlock(self, unconfirmed=False):
        """As the guard does: hold, then make safe; the run waits. The first try may not confirm."""
        self.stand.unconfirmed = unconfirmed
        self.call(lambda: (self.stand.gate.hold(INTERLOCK), self.stand.safety.demand()))
        self.do(self.stand.safety.wait_until_tried())

    def kill(self):
        """Nothing that happens from now on, here the end of its tasks, reaches the disk. The next life begins then."""
        now_ns, journal = self.clock.now_ns(), self._journal_path.read_bytes()
        self._disk.extend(item for item in self._unsaved if item.time_ns <= now_ns - to_ns(COMMIT_EVERY_S))
        self._disk = []
        self.call(self._cancel)
        self.passes(30.0)
        self._time.cancel()
        self._flap.cancel()
        self.do(asyncio.gather(self._time, self._flap, self.run, return_exceptions=True))
        self.do(self._journal.close())
        self.loop.close()
        self._journal_path.write_bytes(journal)
        return now_ns

    def _cancel(self):
        self.stop.begin_takedown()
        self.run.cancel()

    def open_s(self):
        """How long nothing has held the run, in all."""
        since_ns = self.clock.now_ns() if self.stand.gate.reasons else self._open_since_ns
        return (self._open_ns + self.clock.now_ns() - since_ns) / NS_PER_S

    def held_s(self):
        """For how long something has held the run."""
        return (self.clock.now_ns() - self._closed_ns) / NS_PER_S if self.stand.gate.reasons else 0.0

    def _on_gate(self, reason, held):
        self.disturbances += held and reason == INTERLOCK
        if reason == INTERLOCK and not held:
            self.stand.safety.cancel_pending()  # or a late try would undo what the run does from now on
        if held and len(self.stand.gate.reasons) == 1:
            self._closed_ns = self.clock.now_ns()
            self._open_ns += self._closed_ns - self._open_since_ns
        elif not self.stand.gate.reasons:
            self._open_since_ns = self.clock.now_ns()

    def _on_item(self, item):
        self.disturbances += isinstance(item, Event) and item.kind == CAMERA_EQUILIBRIUM_LOST
        if isinstance(item, StepMark):
            self.begun += item.state is StepState.STARTED
        if isinstance(item, StepMark | Frame | Event):
            self._unsaved.append(item)


@contextmanager
def lives(folder, plan, start_ns, decides=None):
    """begin(start_ns, plan): a daemon that runs the plan, or goes on with it; the last one is ended at the end."""
    begun, disk = [], []

    def begin(start_ns=start_ns, plan=plan):
        begun.append(Life(folder, plan, start_ns, disk, 24.0, decides, follows=True))
        return begun[-1]

    yield begin
    if not begun[-1].loop.is_closed():
        begun[-1].kill()
    assert not any(each.wrong for each in begun)
