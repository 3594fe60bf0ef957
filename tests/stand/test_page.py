"""What the page shows, in a real browser. The stand behind it is a desk that a test sets."""

import asyncio
import re
from itertools import combinations
from urllib.parse import parse_qs, urlsplit

import pytest
from axe_playwright_python.base import AXE_SCRIPT

from tests.recording.full_session import record
from tests.stand.browser import PHONE, VIEWS, a_page, needs_chromium
from tests.stand.page_service import frame_of, free_port, serve_cycle, target_image
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import Batch, StepMark, StepState
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.safety.gate import CAMERA_LOST
from thermostand.stand.serving.api_models import HeatByHand, NotConfirmed

pytestmark = [needs_chromium, pytest.mark.asyncio(loop_scope="module")]

INK = """() => { const c = document.querySelector(".curve canvas");
if (!c || !c.width) return 0;
const points = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
return points.filter((value, n) => n % 4 === 3 && value).length }"""
WHOLE_HEADER = """() => [...document.querySelectorAll("header .who, header .doing, header .eta")].every(
    (part) => part.scrollWidth <= part.clientWidth && part.scrollHeight <= part.clientHeight + 1)"""


# Values of five columns, of which the fourth has none; drift counts again in the second.
BY_REFERENCE = """async () => { const { table } = await import("/static/curves.js");
const marks = [{ level: "reference", kind: "camera", time_ns: 1.5e9 },
  { level: "reference", kind: "other", time_ns: 0 }];
const low = { "camera.drift_mean": [1, 2, 3, null, 5] };
const drawn = table({ from_ns: 0, width_ns: 1e9, points: 5, low, high: {}, marks }, ["camera.drift_mean"], 0)[1];
return drawn.map((value) => (value === undefined ? "undefined" : value)) }"""


async def until_looked_at(desk, role):
    async with asyncio.timeout(60):
        while desk.viewing.previews.get("camera") is None or desk.viewing.previews["camera"].role != role:
            await asyncio.sleep(0.05)


async def ink(page):
    """How many points of the first curves' canvas are drawn."""
    return await page.evaluate(INK)


async def picture(page):
    return await page.evaluate("() => document.querySelector('.curve canvas')?.toDataURL() ?? ''")


async def test_the_page_shows_the_stand_and_its_curves_move(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_text("Running", exact=True).wait_for()
        assert await page.locator("#stand").inner_text() == "cold-chamber"
        row = page.locator(".readings tr", has_text="air")
        assert "°C" in await row.locator(".value").inner_text()
        await page.get_by_role("button", name="10 min").click()
        async with asyncio.timeout(30):
            while await ink(page) < 2000:
                await asyncio.sleep(0.1)
            before = await picture(page)
            while await picture(page) == before:
                await asyncio.sleep(0.2)
        trend = row.locator("td").last
        await trend.get_by_text(re.compile(r"K|steady")).wait_for()
        desk.lost = "thermometers"
        await row.locator(".value", has_text="no reading").wait_for()
        assert not await trend.inner_text()  # of what is not read nobody knows where it goes


async def test_what_a_device_measures_in_a_unit_of_its_own_has_a_row_and_a_curve(desk):
    async with a_page(desk.chromium, desk.port) as page:
        now_ns = desk.clock.now_ns()
        pressure = Reading("lab.pressure", 1013.2, "hPa", now_ns)
        desk.hub.publish(Batch("lab", now_ns, (pressure, Reading("lab.wet", 1.0, "1", now_ns))))
        row = page.locator(".readings tr", has_text="lab pressure")
        await row.locator(".value", has_text="1013.20 hPa").wait_for()
        await page.locator(".curve[aria-label*='hPa'] canvas").wait_for()
        assert not await page.locator(".readings tr", has_text="lab wet").count()  # a flag has no curve


async def test_a_thermometer_by_itself_is_no_camera_that_is_off(desk):
    desk.is_camera_on, desk.lost = False, "camera"
    async with a_page(desk.chromium, desk.port) as page:
        now_ns = desk.clock.now_ns()
        asked = page.expect_request(
            lambda request: (
                "/history" in request.url
                and all(each in request.url for each in ("reference.temperature", "drift_mean"))
            )
        )
        async with asked as found:
            broken = bad_reading("reference.temperature", "degC", now_ns, "no reply", "wire")
            desk.hub.publish(Batch("reference", now_ns, (broken,)))
        assert "reference.drift_mean" not in (await found.value).url
        assert "camera.drift_mean" in (await found.value).url
        row = page.locator(".readings tr", has_text="reference temperature")
        await row.locator(".value", has_text="no reading").wait_for()
        await page.locator(".readings tr", has_text="camera").locator(".value", has_text="off").wait_for()


async def test_heat_by_hand_is_seen_at_once_also_while_the_regulator_does_not_answer(desk):
    desk.is_idle = True
    async with a_page(desk.chromium, desk.port, size=PHONE) as page:
        await page.get_by_text("Idle", exact=True).wait_for()
        desk.by_hand = HeatByHand(setpoint_degC=40.0, since_ns=desk.clock.now_ns())
        for desk.lost, shown in (("", "°C"), ("regulator", "no reading"), ("", "°C")):
            await page.locator(".readings tr", has_text="set-point").locator(".value", has_text=shown).wait_for()
            await page.locator("#phase", has_text="Heat by hand").wait_for()
            await page.locator("#doing", has_text="set to 40 °C, on since ").wait_for()
            assert await page.evaluate(WHOLE_HEADER)
        desk.by_hand = None
        await page.get_by_text("Idle", exact=True).wait_for()


async def test_a_held_run_whose_set_point_is_not_read_is_not_shown_as_stopped(desk):
    desk.gate.hold(CAMERA_LOST)
    async with a_page(desk.chromium, desk.port) as page:
        held = page.locator(".notice", has_text="The run is held: a camera does not answer")
        await held.get_by_text("The chamber keeps its set-point.").wait_for()
        desk.lost = "regulator"
        await held.get_by_text("Heat and cold are permitted; the regulator's set-point is not known now.").wait_for()
        now_ns = desk.clock.now_ns()
        desk.hub.publish(Batch("regulator", now_ns, (Reading("regulator.running", 0.0, "1", now_ns),)))
        await held.get_by_text("The regulator is stopped.").wait_for()
        desk.is_heat_permitted = False
        await held.get_by_text("Heat and cold are not permitted.").wait_for()


async def test_what_is_not_confirmed_safe_is_seen_until_it_is(desk):
    """Under a fault, which does not say that the stand is safe meanwhile."""
    desk.trip()
    since_ns, failure = desk.clock.now_ns(), "relays did not confirm its safe state: relays: no answer"
    waiting = NotConfirmed(name="relays", since_ns=since_ns, timer_s=15.0)
    desk.not_confirmed = (waiting, NotConfirmed(name="flap", since_ns=since_ns))
    async with a_page(desk.chromium, desk.port, size=PHONE) as page:
        await page.get_by_role("heading", name="Being made safe: relays, flap", exact=True).wait_for()
        fault = page.locator(".notice", has_text="Tripped: ")
        await fault.get_by_text("That the stand is safe is not yet confirmed.").wait_for()
        desk.not_confirmed = (waiting.model_copy(update={"reason": failure}),)
        alert = page.locator(".notice.error", has_text="Not yet confirmed safe: relays")
        await alert.get_by_text(failure).wait_for()
        first = await page.locator("#notices .notice").first.inner_text()
        assert "at the latest 15 s" in first
        desk.not_confirmed = ()
        await alert.wait_for(state="detached")
        await fault.get_by_text("The stand is made safe.").wait_for()


@pytest.mark.usefixtures("compiled_fit")
async def test_the_drift_of_two_references_is_no_one_line(desk):
    """Two series of reference frames, as of two runs: the page breaks its line where drift begins to count again."""
    history = desk.viewing.history
    async with a_page(desk.chromium, desk.port) as page:
        for moved_px in (0.0, 0.3):
            desk.hub.publish(StepMark(0, "r", 0, "capture", StepState.STARTED, {"role": "reference"}))
            desk.hub.publish(frame_of(target_image(moved_px, 0), desk.clock.now_ns(), "r"))
            desk.hub.publish(StepMark(0, "f", 0, "capture", StepState.STARTED, {"role": "fit"}))
            await until_looked_at(desk, "reference")
            desk.hub.publish(frame_of(target_image(moved_px + 0.5, 0), desk.clock.now_ns(), "f"))
            await until_looked_at(desk, "fit")
        now_ns = desk.clock.now_ns()
        (mark,) = [each for each in history.columns(now_ns - NS_PER_S * 60, now_ns).marks if each.level == "reference"]
        assert mark.kind == "camera"
        broken = await page.evaluate(BY_REFERENCE)
        assert broken == [1, None, 3, "undefined", 5]


async def test_event_marks_and_the_session_are_shown_after_a_reload(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_role("button", name="12 h").click()
        await page.get_by_text("thermometers does not answer").wait_for()
        await page.reload()
        await page.get_by_text("thermometers does not answer").wait_for()
        assert await page.locator("[data-span='43200']").get_attribute("aria-pressed") == "true"


def asked_s(url: str) -> float:
    """The length of the time that curves are asked for; 0 when it is something else that is asked for."""
    query = parse_qs(urlsplit(url).query)
    is_history = "from_ns" in query and "to_ns" in query
    return (int(query["to_ns"][0]) - int(query["from_ns"][0])) / NS_PER_S if is_history else 0.0


async def test_zooming_shows_a_part_of_the_session_and_the_way_back(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_role("button", name="12 h").click()
        await page.get_by_text("thermometers does not answer").wait_for()
        over = await page.locator(".u-over").first.bounding_box()
        async with page.expect_response(lambda answer: 0 < asked_s(answer.url) < 36_000) as asked:  # not the 12 h
            await page.mouse.move(over["x"] + 0.6 * over["width"], over["y"] + 50)
            await page.mouse.down()
            await page.mouse.move(over["x"] + 0.7 * over["width"], over["y"] + 60, steps=4)
            await page.mouse.up()
        found = await (await asked.value).json()
        assert found["points"] * found["width_ns"] / NS_PER_S == pytest.approx(4320, rel=0.15)
        await page.get_by_role("button", name="Back to now").click()
        await page.get_by_role("button", name="Back to now").wait_for(state="hidden")


@pytest.mark.usefixtures("compiled_fit")
async def test_markers_and_drift_of_the_last_frame_are_shown(desk):
    async with a_page(desk.chromium, desk.port, "camera") as page:
        desk.hub.publish(frame_of(target_image(0, 0), desk.clock.now_ns()))
        await page.get_by_text("54 of 54").wait_for()
        desk.hub.publish(frame_of(target_image(0.3, 0), desk.clock.now_ns()))
        await page.get_by_text("worst marker").wait_for()
        async with asyncio.timeout(60):
            while "0.000 px" in await page.locator(".frame + .facts").inner_text():
                await asyncio.sleep(0.1)
        assert "px" in await page.get_by_text("edge width").locator("+ dd").inner_text()
        label = await page.locator(".frame canvas").get_attribute("aria-label")
        assert "54 markers found; mean drift" in label


def overlap_px(one, other):
    """By how much two boxes lie over each other, in the direction in which that is less; negative when apart."""
    return min(
        min(one[at] + one[size], other[at] + other[size]) - max(one[at], other[at])
        for at, size in (("x", "width"), ("y", "height"))
    )


async def test_two_sessions_are_shown_one_over_the_other(desk, tmp_path):
    for name, warm_degC in (("monday", 24.0), ("tuesday", 30.0)):

        def items(time_ns, index, warm_degC=warm_degC):
            air, camera = warm_degC + 0.1 * index, warm_degC + 12 + 0.08 * index
            yield Batch("thermometers", time_ns, (Reading("thermometers.air", air, "degC", time_ns),))
            yield Batch("camera", time_ns, (Reading("camera.temperature", camera, "degC", time_ns),))

        await record(tmp_path / "sessions" / name, 40, items, segment_s=3600, period_ns=60 * NS_PER_S)
    async with a_page(desk.chromium, desk.port, "sessions") as page:
        for name in ("monday", "tuesday"):
            await page.get_by_label(f"Choose {name}").check()
        await page.get_by_role("button", name="Compare these two sessions").click()
        curves = page.get_by_role("img", name="Temperatures of monday and tuesday")
        await curves.locator("canvas").wait_for()
        assert await curves.evaluate("(place) => place.querySelector('canvas').width") > 400
        for text in ("solid: monday", "dashed: tuesday", "monday: no drift", "tuesday: no drift"):
            await page.get_by_text(text).wait_for()
        await page.get_by_role("button", name="Close").click()
        await curves.wait_for(state="detached")
    async with a_page(desk.chromium, desk.port, "sessions", PHONE) as page:
        row = page.locator(".sessions tr", has_text="monday")
        await row.get_by_text("2026", exact=False).wait_for()  # of which year, also in that year
        boxes = [box for cell in await row.locator("td").all() if (box := await cell.bounding_box())]
        assert not [(a, b) for a, b in combinations(boxes, 2) if overlap_px(a, b) > 1]


async def test_the_page_finds_the_stand_again_after_the_daemon_restarts(tmp_path, chromium):
    port = free_port()
    async with serve_cycle(tmp_path / "sessions", port) as first:
        manager = a_page(chromium, port)
        page = await manager.__aenter__()
        await page.get_by_text("Running", exact=True).wait_for()
        first.tell("before the restart")
    await page.locator("#phase", has_text="No connection").wait_for()
    await page.get_by_text("What is shown is of").wait_for()
    await page.get_by_role("link", name="Queue").click()  # whose recipes nobody gives now
    async with serve_cycle(tmp_path / "sessions", port) as second:
        await page.locator("#phase", has_text="Running").wait_for()
        await page.get_by_text("No connection to the stand").wait_for(state="detached")
        await page.locator("#recipe option").first.wait_for(state="attached")
        second.trip()
        await page.locator("#phase", has_text="Tripped").wait_for()
        await manager.__aexit__(None, None, None)


async def test_a_phone_is_wide_enough_for_every_view(desk):
    async with a_page(desk.chromium, desk.port, size=PHONE, scheme="dark") as page:
        for view in VIEWS:
            await page.goto(f"http://127.0.0.1:{desk.port}/#{view}")
            await page.wait_for_timeout(500)
            assert await page.evaluate("() => document.documentElement.scrollWidth <= innerWidth"), view
            assert await page.evaluate(WHOLE_HEADER), view
        await page.goto(f"http://127.0.0.1:{desk.port}/#now")
        boxes = [await page.get_by_role("heading", name=name).bounding_box() for name in ("Readings", "Temperatures")]
        assert boxes[0]["y"] < boxes[1]["y"]


AXE = """async (rules) => {
const only = rules && { runOnly: { type: "rule", values: rules } };
const found = await axe.run({ resultTypes: ["violations"], ...only });
const all = [found.violations, found.passes, found.incomplete, found.inapplicable].flat();
return { colour: all.filter((each) => each.tags.includes("cat.color")).map((each) => each.id),
    violations: found.violations.map((each) => [each.id, each.nodes.map((node) => node.html)]) } }"""


async def test_every_view_is_accessible(desk):
    """axe finds nothing; a fault, a prompt and a pause are on the page. In the dark only its rules of colour are asked:
    nothing but colours is other there (test_the_dark_changes_colours_only)."""
    desk.trip()
    desk.ask_operator("Roll the camera by 20 degrees")
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_role("button", name="Look at it and reset").click()
        await page.evaluate(AXE_SCRIPT)
        for view in VIEWS:
            await page.goto(f"http://127.0.0.1:{desk.port}/#{view}")
            await page.wait_for_timeout(800)
            light = await page.evaluate(AXE)
            assert light["violations"] == [], view
            assert "color-contrast" in light["colour"]
            await page.emulate_media(color_scheme="dark")
            dark = await page.evaluate(AXE, light["colour"])
            assert dark["violations"] == [], f"{view}, dark"
            await page.emulate_media(color_scheme="light")
