"""A stand in the middle of a session, without a stand behind it: a desk whose faults, prompts and readings a test sets,
a history of twelve hours, and frames of a target that drifts. Served with the page as the daemon serves it."""

from __future__ import annotations

import asyncio
import math
import socket
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import JsonValue

from tests.stand.fake_service import FakeService, serve_fake
from thermostand.experiments.steps import PlannedStep, make_step
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.documents import parse_document
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading, bad_reading
from thermostand.stand.config.interface_section import RemoteStand
from thermostand.stand.config.own_recipes import read_recipe, remove_recipe, save_recipe
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.running.memory.entries import StepChanged as StepChanged
from thermostand.stand.running.memory.fold import fold
from thermostand.stand.running.order import load_order
from thermostand.stand.running.run_control import check_edit
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import INTERLOCK, OPERATOR
from thermostand.stand.service.run_preview import Turn, preview_order
from thermostand.stand.service.stand_service import (
    ExtendRequest,
    PauseRequest,
    RecipeRequest,
    SaveRequest,
    SkipRequest,
)
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api_models import (
    Argument,
    DeviceState,
    DeviceVerb,
    FaultState,
    PlanCheck,
    PlanStep,
    PromptState,
    QueuedRun,
    Requester,
    RunPreview,
    RunRequest,
    RunStatus,
    StandState,
    StepStanding,
    WrittenStep,
)
from thermostand.stand.serving.page_data import PageData
from thermostand.stand.serving.page_routes import PageRoutes

TARGET = (Path(__file__).parents[2] / "configs" / "targets" / "paper-9x6.yaml").read_text("utf-8")
SESSION_S = 12 * 3600
SET_POINTS = (24.0, 31.0, 38.0, 45.0, 52.0, 45.0, 31.0, 24.0, 17.0, 10.0, 17.0, 24.0)
SOAK_S = 3600.0
STEPS = 3 * len(SET_POINTS)


def set_point_degC(t_s: float) -> float:
    """Of the session's hour."""
    return SET_POINTS[min(max(int(t_s // SOAK_S), 0), len(SET_POINTS) - 1)]


class CycleService(FakeService):
    """A thermal cycle in its eleventh hour. `now_s` is the second of the session."""

    def __init__(self) -> None:
        super().__init__()
        self.prompt: PromptState | None = None
        self.is_idle = False
        self.pausing = False
        self.is_heat_permitted = self.is_camera_on = True
        self.lost = ""  # a device that does not answer
        self.stops = 0
        self.viewing: PageData | None = None
        self.began_ns = self.clock.now_ns() - round(10.6 * 3600 * NS_PER_S)
        self.config = load_config(find_packaged("", "simulated"))
        self._air, self._granite, self._camera = 24.0, 24.0, 38.0
        self.queue = [
            QueuedRun(id=3, recipe="validation", state="waiting", added_ns=self.began_ns, expected_s=36_300.0),
            QueuedRun(id=4, recipe="warm-up", state="waiting", added_ns=self.began_ns, added_by="anna"),
        ]

    def batch(self, air_degC: float) -> Batch:
        """A poll before any other."""
        now_ns = self.clock.now_ns()
        return Batch("thermometers", now_ns, (Reading("thermometers.air", air_degC, "degC", now_ns),))

    def now_s(self) -> float:
        return (self.clock.now_ns() - self.began_ns) / NS_PER_S

    def state(self) -> StandState:
        base = super().state()
        now_ns = self.clock.now_ns()
        reasons = tuple(sorted(self.gate.reasons))
        phase = "idle" if self.is_idle else "stopping" if self.stops else "held" if reasons else "running"
        values = {name: each.value for name, each in base.readings.items() if each.value is not None}
        run = RunStatus(
            recipe="overnight",
            step=32,
            steps=STEPS,
            doing=f"soak at {set_point_degC(self.now_s()):g} °C",
            state="held" if reasons else "running",
            reasons=reasons,
            now_ns=now_ns,
            since_ns=now_ns - 600 * NS_PER_S,
            end_ns=self.began_ns + SESSION_S * NS_PER_S,
            temperatures_degC={},
            frames_saved=3914,
            frames_lost=0,
            disk_free_bytes=812_000_000_000,
            session="/data/20261122T180000Z-overnight",
            run_id="20261122T180000Z-overnight",
        )
        return base.model_copy(
            update={
                "stand": "cold-chamber",
                "phase": phase,
                "run": None if self.is_idle else run,
                "reasons": reasons,
                "prompt": self.prompt,
                "setpoint_degC": None if self.lost == "regulator" else set_point_degC(self.now_s()),
                "output_percent": values.get("regulator.mv_heat"),
                "heater_permitted": self.is_heat_permitted and not self.tripped,
                "compressor_on": bool(values.get("relays.compressor")),
                "pausing": self.pausing,
                "camera_on": self.is_camera_on,
                "cameras": ("camera",),
                "flap": "closed",
                "axes": {"linear": 135.0, "rotary": -15.0},
                "counters": {"compressor_hours": 1204.5, "compressor_starts": 3110.0, "flap_cycles": 18220.0},
                "disk_free_bytes": 812_000_000_000,
            }
        )

    async def preview(self, request: RunRequest) -> RunPreview:
        """On the simulated stand, behind what is queued."""
        text = request.recipe_text or read_recipe(self.sessions, request.recipe)
        waiting = sum(each.state == "waiting" for each in self.queue)
        turn = Turn("queued", waiting, None) if waiting else Turn("now", 0, self.clock.now_ns())
        return preview_order(replace(load_order("demo", "simulated"), **self._parse(text)), self.sessions, turn, ())

    def _parse(self, text: str) -> dict[str, Any]:
        return {"recipe_text": text, "recipe": parse_document(text, Recipe, "the recipe")}

    async def save_recipe(self, who: Requester, given: SaveRequest) -> str:
        save_recipe(str(self.sessions), given.recipe, given.recipe_text)
        return f"saved as {given.recipe}"

    async def remove_recipe(self, who: Requester, given: RecipeRequest) -> str:
        remove_recipe(str(self.sessions), given.recipe)
        return f"the recipe {given.recipe} is removed"

    async def rehearse(self, who: Requester, given: RunRequest) -> str:
        self.rehearsed = (await self.preview(given)).recipe
        return "rehearsed"

    def plan(self) -> tuple[PlanStep, ...]:
        return tuple(self._step(index) for index in range(STEPS))

    def _step(self, index: int) -> PlanStep:
        kinds = (("start_chamber", "set {:g} °C", 2.0), ("soak", "soak 55 min at {:g} °C", 3300.0))
        kind, text, duration_s = (*kinds, ("capture", "5 frames at {:g} °C", 298.0))[index % 3]
        degC: dict[str, JsonValue] = {"chamber_degC": SET_POINTS[index // 3]}
        soak: dict[str, JsonValue] = {"duration_s": duration_s}
        frames: dict[str, JsonValue] = {"frames": 5, "interval_s": 60.0, "exposure_s": 0.1, "role": "other", **degC}
        begin_s = index // 3 * SOAK_S + (0.0, 2.0, 3302.0)[index % 3]
        end_s, now_s = begin_s + duration_s * (1 + 0.01 * math.sin(index)), self.now_s()
        standing: StepStanding = "done" if end_s < now_s else "under_way" if begin_s <= now_s else "waiting"
        begun, ended = standing != "waiting", standing == "done"
        return PlanStep(
            step_id=f"{index:03d}-{kind.lower()}",
            index=index,
            kind=kind,
            parameters=(degC, soak, frames)[index % 3],
            text=text.format(SET_POINTS[index // 3]),
            standing=standing,
            duration_s=duration_s,
            soaked_s=max(0.0, min(duration_s, now_s - begin_s)) if kind == "soak" and begun else 0.0,
            frames=5 if kind == "capture" else 0,
            frames_saved=5 if kind == "capture" and ended else 0,
            began_ns=self._at(begin_s) if begun else None,
            ended_ns=self._at(end_s) if ended else None,
            expected_ns=None if ended else self._at(end_s),
        )

    def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """As a run does, whose plan is this session's."""
        shown = self.plan()
        plan = [PlannedStep(each.index, each.step_id, make_step(each.kind, dict(each.parameters))) for each in shown]
        marks = [StepChanged(0, each.step_id, "started") for each in shown if each.standing != "waiting"]
        marks += [StepChanged(0, each.step_id, "done") for each in shown if each.standing == "done"]
        return check_edit(fold(plan, marks), from_index, steps, self.config)

    def devices(self) -> tuple[DeviceState, ...]:
        refused = "" if self.is_idle else "a run owns the stand"
        warm = Argument(name="setpoint_degC", unit="degC", minimum=-10, maximum=70)
        way = Argument(name="position_mm", unit="mm", minimum=0, maximum=280)
        return (
            DeviceState(
                name="chamber",
                kind="regulator",
                channels=("regulator.pv", "regulator.sp", "regulator.mv_heat"),
                verbs=(
                    DeviceVerb(verb="set", text="Hold this temperature", role="commission", arguments=(warm,)),
                    DeviceVerb(verb="stop", text="Stop heating and cooling"),
                ),
                refused=refused,
            ),
            DeviceState(
                name="flap",
                kind="flap",
                verbs=(DeviceVerb(verb="open", text="Open"), DeviceVerb(verb="close", text="Close")),
                refused=refused,
            ),
            DeviceState(
                name="linear",
                kind="axis",
                channels=("linear.position",),
                verbs=(DeviceVerb(verb="move", text="Move", arguments=(way,)), DeviceVerb(verb="home", text="Home")),
                refused=refused,
            ),
            DeviceState(name="camera", kind="camera", verbs=(DeviceVerb(verb="frame", text="Take one frame"),)),
        )

    def pause(self, who: Requester, given: PauseRequest) -> str:
        self.pausing = given.when == "step"
        return "" if self.pausing else super().pause(who, given)

    def continue_(self, who: Requester) -> str:
        self.prompt, self.pausing = None, False
        return super().continue_(who)

    def reset(self, who: Requester) -> str:
        done = super().reset(who)
        self.tripped = None
        return done

    async def skip(self, who: Requester, given: SkipRequest) -> str:
        return ""

    async def extend(self, who: Requester, given: ExtendRequest) -> str:
        return ""

    def stop(self, who: Requester) -> str:
        self.stops += 1
        return "the stand is made safe"

    def trip(self) -> None:
        """The air is too warm."""
        self.gate.hold(INTERLOCK)
        text = "thermometers.air is at 71.2 degC, above 70 degC"
        data = {"channel": "thermometers.air", "value": 71.2, "limit": 70.0, **Fault("air_too_warm", text).data}
        self.tripped = FaultState(rule="air_too_warm", text=text, since_ns=self.clock.now_ns(), data=data)
        self.hub.publish(Event(self.clock.now_ns(), "error", "tripped", text, data))

    def ask_operator(self, text: str) -> None:
        """As the step `prompt` does."""
        self.gate.hold(OPERATOR)
        self.prompt = PromptState(step_id="031-prompt", text=text)
        self.hub.publish(Event(self.clock.now_ns(), "warning", "prompt", text))

    def _at(self, t_s: float) -> int:
        return self.began_ns + round(t_s * NS_PER_S)

    def batches(self, t_s: float, period_s: float) -> list[Batch]:
        """What is polled at that second of the session: a chamber of the first order, and what follows it."""
        time_ns, target = self._at(t_s), set_point_degC(t_s)
        self._air += (target - self._air) * (1 - math.exp(-period_s / 420)) + 0.02 * math.sin(t_s * 1.7)
        self._granite += (self._air - self._granite) * (1 - math.exp(-period_s / 5400))
        self._camera += (self._air + 13.5 - self._camera) * (1 - math.exp(-period_s / 1500))
        power = 50 + 9 * (target - self._air) + 0.7 * (target - 24) + 3 * math.sin(t_s / 31)
        cools = target < 20 or self._air > target + 1.5

        def degC(channel: str, value: float) -> Reading:
            return Reading(channel, value, "degC", time_ns)

        places = {
            "air": self._air,
            "granite_inside": self._granite,
            "granite_outside": 0.3 * self._granite + 0.7 * 23.4,
            "artifact": 23.1 + 0.2 * math.sin(t_s / 5000),
            "laboratory": 22.4 + 0.5 * math.sin(t_s / 9000),
        }
        return [
            Batch("thermometers", time_ns, tuple(degC(f"thermometers.{name}", x) for name, x in places.items())),
            Batch("camera", time_ns, (degC("camera.temperature", self._camera),)),
            Batch(
                "regulator",
                time_ns,
                (
                    degC("regulator.pv", self._air + 0.1),
                    degC("regulator.sp", target),
                    Reading("regulator.mv_heat", min(100.0, max(0.0, power)), "%", time_ns),
                    Reading("regulator.mv_cool", 60.0 if cools else 0.0, "%", time_ns),
                ),
            ),
            Batch("relays", time_ns, (Reading("relays.compressor", float(cools), "1", time_ns),)),
            Batch("linear", time_ns, (Reading("linear.position", 135.0, "mm", time_ns),)),
        ]

    def drift_px(self, t_s: float) -> float:
        """Of the image, as the camera is warmer than at the beginning."""
        return 0.021 * (self._camera - 37.5) * (1 + 0.02 * math.sin(t_s))

    def live_through(self, viewing: PageData, period_s: float = 30.0) -> None:
        """The session until now, into the history only."""
        t_s, history = 0.0, viewing.history
        while t_s < self.now_s():
            for batch in self.batches(t_s, period_s):
                history(batch)
            if t_s % 300 < period_s:
                history.add("camera.drift_mean", self._at(t_s), abs(self.drift_px(t_s)), "px")
                history.add("camera.drift_worst", self._at(t_s), 1.6 * abs(self.drift_px(t_s)) + 0.01, "px")
            t_s += period_s
        for t_s, level, kind, text in (
            (5.0, "info", "run.start", "recipe overnight, 36 steps, 3,974 frames"),
            (9300.0, "warning", "device_lost", "thermometers does not answer (3 polls); readings are STALE"),
            (9340.0, "info", "device_back", "thermometers answers again, after 40 s"),
            (22300.0, "info", "compressor", "compressor started"),
            (31000.0, "warning", "guard_late", "the guard looked 6.1 s after its last look; permits wait"),
        ):
            history(Event(self._at(t_s), level, kind, text))
        for step in self.plan():
            if step.began_ns is not None:
                history(StepMark(step.began_ns, step.step_id, step.index, step.kind, StepState.STARTED, {}))

    async def end_pause(self) -> None:
        """Poll once a second."""
        while True:
            for batch in self.batches(self.now_s(), 1.0):
                self.hub.publish(_lost(batch) if batch.device == self.lost else batch)
            await asyncio.sleep(1.0)


def _lost(batch: Batch) -> Batch:
    bad = (bad_reading(each.channel, each.unit, each.time_ns, "no answer", "wire") for each in batch.readings)
    return Batch(batch.device, batch.time_ns, tuple(bad))


def target_image(dx: float, dy: float, size: tuple[int, int] = (1224, 1024)) -> np.ndarray:
    """A picture of the paper's target, 9 x 6 discs, moved by that many px; no truth is measured with it."""
    width, height = size
    image = np.full((height, width), 198, np.uint8)
    pitch, radius, shift = width / 11.5, width / 85, 4
    for row in range(6):
        for column in range(9):
            x, y = (column - 4) * pitch + width / 2 + dx * (1 + 0.1 * column), (row - 2.5) * pitch + height / 2 + dy
            centre = (round(x * 2**shift), round(y * 2**shift))
            cv2.circle(image, centre, round(radius * 2**shift), 34, -1, cv2.LINE_AA, shift)
    noise = np.random.default_rng(1).normal(0, 1.5, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 1.2) + noise, 0, 255).astype(np.uint8)


def frame_of(image: np.ndarray, time_ns: int, step_id: str = "") -> Frame:
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 38.0, 1, 1, step_id=step_id)


def free_port() -> int:
    """One that nobody listens at now."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@asynccontextmanager
async def serve_cycle(
    folder: Path,
    port: int,
    *,
    with_frames: bool = False,
    stands: tuple[RemoteStand, ...] = (),
    prepare: Callable[[CycleService], None] = lambda _: None,
) -> AsyncGenerator[CycleService]:
    """The session, served at that port while inside."""
    desk = CycleService()
    desk.clock = desk.clock if isinstance(desk.clock, WallClock) else WallClock()
    desk.sessions = folder
    prepare(desk)
    viewing = PageData(desk.hub, desk.clock, folder, TARGET)
    desk.live_through(viewing)
    desk.viewing = viewing
    folder.mkdir(exist_ok=True)
    polling = asyncio.create_task(desk.end_pause())
    try:
        async with serve_fake(
            desk, folder / "now", Interface(folder, port=port, stands=stands, extra_routes=(PageRoutes(viewing),))
        ):
            if with_frames:
                desk.hub.publish(frame_of(target_image(0, 0), desk.began_ns))
                while not viewing.previews:
                    await asyncio.sleep(0.1)
                moved = desk.drift_px(desk.now_s())
                desk.hub.publish(frame_of(target_image(0.7 * moved, -0.5 * moved), desk.clock.now_ns()))
            yield desk
    finally:
        polling.cancel()
