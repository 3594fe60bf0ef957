"""What the page costs: memory of a page that lives through a session, how soon curves are answered, what viewers take.

A session of 24 h, all that is polled, is published as fast as it goes while the page is open at 24 h of curves. Then
two viewers follow a stand that takes two frames a second; what they cost is the daemon's processor time with them less
that without. Markers are looked for by another process, whose time is given apart.
"""

from __future__ import annotations

import asyncio
import resource
import statistics
import time
import urllib.request
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

from tests.bench.figures import Figure, make_skipped, report_progress, set_upper_goal
from tests.bench.waiting import compare_with_waiting, compute_p99, run_waiting_process
from tests.stand.browser import CHROMIUM, a_page, browser
from tests.stand.page_service import CycleService, frame_of, free_port, serve_cycle, target_image
from thermostand.foundation.clock import NS_PER_S

DAY_S = 24 * 3600
POLL_s = 5.0
ASKED = 200
WATCHED_s = 20.0
FRAMES_per_s = 2.0
CHANNELS = (
    "regulator.sp,thermometers.air,camera.temperature,thermometers.granite_inside,thermometers.granite_outside,"
    "thermometers.artifact,thermometers.laboratory,regulator.mv_heat,regulator.mv_cool,relays.compressor,"
    "camera.drift_mean,camera.drift_worst"
)


def figures(directory: Path) -> list[Figure]:
    """Heap of the page, MB; answers of the curves, ms; two viewers, % of a core."""
    if not CHROMIUM:
        return [make_skipped("the page", RuntimeError("no chromium is installed"))]
    return asyncio.run(_figures(directory))


async def _figures(directory: Path) -> list[Figure]:
    port = free_port()
    async with serve_cycle(directory / "sessions", port) as desk, browser() as chromium:
        return [*await _measure_long_page(desk, chromium, port), await _measure_viewers(desk, chromium, port)]


async def _measure_long_page(desk: CycleService, chromium: Any, port: int) -> list[Figure]:
    report_progress("a page open for 24 h of a replayed session")
    async with a_page(chromium, port) as page:
        await page.get_by_role("button", name="24 h").click()
        await page.wait_for_timeout(3000)
        before_MB = await _heap_MB(page)
        begin_s = desk.now_s() - DAY_S
        t_s, seen_MB = begin_s, [before_MB]
        while t_s < begin_s + DAY_S:
            for batch in desk.batches(t_s, POLL_s):
                desk.hub.publish(batch)
            t_s += POLL_s
            if round(t_s - begin_s) % 600 == 0:
                await asyncio.sleep(0.05)  # the page draws meanwhile
            if round(t_s - begin_s) % 7200 == 0:
                await page.evaluate("() => dispatchEvent(new Event('visibilitychange'))")
                seen_MB.append(await _heap_MB(page))
        await page.wait_for_timeout(3000)
        seen_MB.append(await _heap_MB(page))
    with run_waiting_process() as waited_ms:
        answers_ms = await asyncio.to_thread(_measure_answers_ms, port, desk)
    peer = f"{before_MB:.1f} MB at first, {seen_MB[-1]:.1f} MB at the end"
    reported = f"p99 of {ASKED}; median {statistics.median(answers_ms):.1f} ms"
    return [
        set_upper_goal(100, Figure("page open for 24 h of a session, heap in use at most", "MB", max(seen_MB), peer)),
        set_upper_goal(
            50,
            compare_with_waiting(
                Figure(
                    "curves of 24 h in 1200 columns, 12 channels, answered", "ms", compute_p99(answers_ms), reported
                ),
                waited_ms,
            ),
        ),
    ]


async def _heap_MB(page: Any) -> float:
    """What the page's scripts hold, after a collection."""
    session = await page.context.new_cdp_session(page)
    try:
        await session.send("HeapProfiler.collectGarbage")
        return (await session.send("Runtime.getHeapUsage"))["usedSize"] / 1e6
    finally:
        await session.detach()


def _measure_answers_ms(port: int, desk: CycleService) -> list[float]:
    to_ns = desk.clock.now_ns()
    query = f"from_ns={to_ns - DAY_S * NS_PER_S}&to_ns={to_ns}&points=1200&channels={CHANNELS}"
    found_ms: list[float] = []
    for _ in range(ASKED):
        began_s = time.perf_counter()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/v1/history?{query}", timeout=30) as answer:
            answer.read()
        found_ms.append((time.perf_counter() - began_s) * 1e3)
    return found_ms


async def _measure_viewers(desk: CycleService, chromium: Any, port: int) -> Figure:
    report_progress("two viewers of two frames a second")
    images = [target_image(0.05 * index, 0, (2448, 2048)) for index in range(4)]
    desk.hub.publish(frame_of(images[0], desk.clock.now_ns()))
    while desk.viewing is None or not desk.viewing.previews:
        await asyncio.sleep(0.1)

    async def frames() -> None:
        end_s, index = time.monotonic() + WATCHED_s, 0
        while time.monotonic() < end_s:
            desk.hub.publish(frame_of(images[index % 4], desk.clock.now_ns()))
            index += 1
            await asyncio.sleep(1 / FRAMES_per_s)

    alone = await _load_percent(frames)
    async with AsyncExitStack() as stack:
        for _ in range(2):
            page = await stack.enter_async_context(a_page(chromium, port))
            await page.get_by_text("markers found").wait_for()
        await asyncio.sleep(2)
        watched = await _load_percent(frames)
    peer = f"{watched:.1f} % with them, {alone:.1f} % without (frames handed to the other process)"
    return set_upper_goal(5, Figure("two viewers at 2 fps, of one core", "%", max(0.0, watched - alone), peer))


async def _load_percent(work: Callable[[], Awaitable[None]]) -> float:
    """Processor time of this process while it works, % of a core."""

    def used_s() -> float:
        found = resource.getrusage(resource.RUSAGE_SELF)
        return found.ru_utime + found.ru_stime

    began_s, before_s = time.monotonic(), used_s()
    await work()
    return (used_s() - before_s) / (time.monotonic() - began_s) * 100
