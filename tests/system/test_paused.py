"""A pause, over the wires: what still moves is reported, and after its limit the stand is made safe and held."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from tests.daemon_queries import ask
from tests.system.test_guard_run import LONG_SOAK, Watcher, run_operated
from tests.system.test_guard_wire import Start, bench_of
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.assemble import Assembly
from thermostand.stand.running.memory.fold import fold
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.running.order import Order
from thermostand.stand.running.run_control import RunControl
from thermostand.stand.service.stand_service import PauseRequest, StandService
from thermostand.stand.serving.api_models import CommandAnswer, Requester


def service_of(assembly: Assembly) -> StandService:
    """Of a run of which only the stand is asked."""
    log, nothing = Logbook(assembly.hub, assembly.clock, fold((), ())), cast("Any", None)
    course = RunControl(assembly, Path("session"), Stop(), log, nothing, nothing, nothing)
    active_run, open_stand = SimpleNamespace(course=course), SimpleNamespace(assembly=assembly)
    return StandService(cast("Any", SimpleNamespace(open_stand=open_stand, active_run=active_run)))


def paused(service: StandService) -> tuple[tuple[str, ...], tuple[str, ...]]:
    done = service.perform("pause", Requester(name="somebody", how="socket"), PauseRequest())
    assert isinstance(done, CommandAnswer)
    return done.reasons, done.moving


async def test_the_answer_to_a_pause_says_what_still_moves(order: Callable[..., Order], simulator: Start):
    async with bench_of(order(), simulator) as bench:
        stand = bench.assembly.stand
        service = service_of(bench.assembly)
        tasks = [
            asyncio.create_task(stand.table.move_to("linear", 140)),
            asyncio.create_task(stand.imaging.open_flap()),
        ]
        await bench.wait(1)
        assert paused(service) == (("operator",), ("linear homing, then to 140 mm", "flap opening"))
        await asyncio.gather(*tasks)
        assert paused(service) == (("operator",), ())
        tasks = [asyncio.create_task(stand.table.move_to("linear", 1)), asyncio.create_task(stand.imaging.close_flap())]
        await bench.wait(1)
        assert paused(service) == (("operator",), ("linear to 1 mm", "flap closing"))
        await asyncio.gather(*tasks)


async def test_a_pause_that_lasts_too_long_is_made_safe_and_held(tmp_path: Path, order: Callable[..., Order]):
    ordered, out, watcher = order(LONG_SOAK, guard={"pause_limit_h": 0.25}), tmp_path / "out", Watcher()
    reasons: list[object] = []

    async def operate() -> None:
        await watcher.event("run.start", 60)
        (directory,) = out.iterdir()
        await watcher.wait(600)
        await asyncio.to_thread(ask, directory, "pause")
        await watcher.event("held", 60)
        trip = await watcher.event("guard.paused_too_long", 960)
        assert trip.data == {"rule": "paused_too_long", "action": "hold", "ends_itself": False}
        await watcher.wait(60)
        reasons.append((await asyncio.to_thread(ask, directory, "continue"))["reasons"])
        reasons.append((await asyncio.to_thread(ask, directory, "reset"))["reasons"])
        await watcher.event("restored", 60)
        await asyncio.to_thread(ask, directory, "stop")

    await run_operated(ordered, out, watcher, operate())
    assert reasons == [["interlock"], []]
    (directory,) = out.iterdir()
    session = Session.open(directory)
    (trip,) = [event for event in session.events() if event.kind == "guard.paused_too_long"]
    (restored,) = [event for event in session.events() if event.kind == "restored"]
    times_ns, running = session.readings("regulator.running")
    assert running[(times_ns > trip.time_ns + 10e9) & (times_ns < restored.time_ns)].max() == 0
