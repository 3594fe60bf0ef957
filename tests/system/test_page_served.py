"""The page of a stand that is really served: a browser, the daemon and the simulated laboratory over their wires."""

import asyncio
import signal
import subprocess
import sys

import pytest

from tests import fork_server
from tests.stand.browser import a_page, browser, needs_chromium
from tests.stand.page_service import free_port
from tests.system.test_daemon import Served

pytestmark = needs_chromium

# Frames, then a prompt, then a long soak.
RECIPE = """
name: seen
steps:
  - start_chamber: 24
  - open_flap
  - capture: {frames: 4, role: reference, interval_s: 0.5, exposure_s: 0.01}
  - close_flap
  - prompt: Roll the camera by 20 degrees
  - soak: 3600
"""


class ServedPage(Served):
    """With a port for browsers."""

    def __init__(self, config_file, out, port):
        self.out = out
        arguments = ["serve", str(config_file), "--out", str(out), "--port", str(port)]
        command = [sys.executable, "-m", "thermostand.stand.cli", *arguments]
        self.process = fork_server.popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.fixture
def served_page(tmp_path, laboratory):
    started, port = [], free_port()

    def start():
        started.append(ServedPage(laboratory, tmp_path / "out", port))
        return started[-1], port

    yield start
    for served in started:
        served.process.kill()
        served.process.communicate()


async def until(served, wanted):
    return await asyncio.to_thread(served.until, wanted)


async def test_a_session_is_begun_watched_paused_and_stopped_in_a_browser(served_page):
    """And the daemon ends and comes again under the open page."""
    served, port = served_page()
    await until(served, lambda state: state.phase == "idle" and len(state.readings) > 10)
    async with browser() as chromium, a_page(chromium, port) as page:
        page.set_default_timeout(120_000)
        await page.locator("#phase", has_text="Idle").wait_for()
        await page.locator(".readings tr", has_text="granite inside").locator(".value", has_text="°C").wait_for()
        await asyncio.to_thread(served.post, "queue", recipe_text=RECIPE, attended=True)
        await page.locator("#phase", has_text="Running").wait_for()
        await page.get_by_text("Roll the camera by 20 degrees").first.wait_for()
        await page.get_by_role("button", name="Done, go on").click()
        await page.get_by_text("The run waits for you").wait_for(state="detached")
        # This laboratory's camera sees a part of the target, in the dark: the page says why no marker is found.
        await page.locator(".frame + .facts", has_text="markers found").wait_for()
        await page.get_by_text(", reference").wait_for()
        await page.goto(f"http://127.0.0.1:{port}/#plan")
        await page.locator(".steps li[data-standing='under_way']", has_text="soak").wait_for()
        await page.get_by_role("button", name="+15 min").click()
        await page.locator(".steps li[data-standing='under_way']", has_text="1 h 15 min").wait_for()
        plan = await asyncio.to_thread(served.server.request, "GET", "/api/v1/plan", None)
        state = await asyncio.to_thread(served.state)
        assert plan[-1]["duration_s"] == 4500.0
        assert abs(plan[-1]["expected_ns"] - state.run.end_ns) < 5e9  # the row and the header
        await page.get_by_role("button", name="Pause now").click()
        await page.locator("#phase", has_text="Held").wait_for()
        await until(served, lambda state: state.reasons == ("operator",))
        await page.locator("main").get_by_role("button", name="Continue").click()
        await until(served, lambda state: state.reasons == ())
        await page.locator("#stop").click()
        await until(served, lambda state: state.run is None and not state.heater_permitted)
        await page.locator("#phase", has_text="Idle").wait_for()

        served.process.send_signal(signal.SIGTERM)
        await page.locator("#phase", has_text="No connection").wait_for()
        assert await asyncio.to_thread(served.process.wait, 60) == 0
        again, _ = served_page()
        await until(again, lambda state: len(state.readings) > 10)
        await page.locator("#phase", has_text="Idle").wait_for()
        await page.goto(f"http://127.0.0.1:{port}/#now")
        await page.locator(".events", has_text="Roll the camera").wait_for()  # of before the restart


async def test_a_run_begun_by_the_form_goes_on_without_a_browser(served_page):
    served, port = served_page()
    await until(served, lambda state: state.phase == "idle" and len(state.readings) > 10)
    async with browser() as chromium:
        async with a_page(chromium, port, "queue") as page:
            page.set_default_timeout(120_000)
            await page.locator("#recipe option", has_text="trial").wait_for(state="attached")
            await page.locator("#recipe").select_option("trial")
            await page.get_by_text("A quarter of an hour").wait_for()
            await page.get_by_role("button", name="Add to the queue").click()
            await page.get_by_text("(trial) is queued").wait_for()
        await until(served, lambda state: state.run is not None and state.run.step > 1)
        async with a_page(chromium, port, "sessions") as page:
            page.set_default_timeout(120_000)
            await page.locator(".sessions tr", has_text="running").filter(has_text="trial").wait_for()
