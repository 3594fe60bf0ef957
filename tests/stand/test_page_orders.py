"""What is ordered on the page, in a real browser, as somebody uses it at night. The stand behind it is a desk that a
test sets."""

import asyncio
import json
import re

import pytest

from tests.stand.browser import DESKTOP, PHONE, VIEWS, a_page, needs_chromium
from thermostand.foundation.documents import parse_document
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.safety.gate import NOT_RECORDED, OPERATOR
from thermostand.stand.serving.api_models import NotConfirmed, QueuedRun

pytestmark = [needs_chromium, pytest.mark.asyncio(loop_scope="module")]

STOP_IS_ON_TOP = """() => { const b = document.getElementById("stop").getBoundingClientRect();
const [w, h] = [b.width, b.height];
const inside = b.top >= 0 && b.left >= 0 && b.right <= innerWidth && b.bottom <= innerHeight;
const points = [[8, 8], [w - 8, 8], [8, h - 8], [w - 8, h - 8], [w / 2, h / 2]];
return inside && points.every(([x, y]) => document.elementFromPoint(b.left + x, b.top + y)?.id === "stop") }"""


BELOW_HEADER = """() => document.activeElement.matches("input:invalid") &&
document.activeElement.getBoundingClientRect().top >= document.querySelector("header").getBoundingClientRect().bottom"""


async def until(check, timeout_s=30.0):
    """Wait for what another process does."""
    async with asyncio.timeout(timeout_s):
        while not check():
            await asyncio.sleep(0.05)


async def test_pause_and_continue_make_the_round(desk):
    async with a_page(desk.chromium, desk.port, "plan") as page:
        await page.get_by_role("button", name="Pause now").click()
        await page.locator("#phase", has_text="Held").wait_for()
        assert desk.gate.reasons == {OPERATOR}
        await page.get_by_text("paused by an operator").first.wait_for()
        await page.locator("main").get_by_role("button", name="Continue").click()
        await page.locator("#phase", has_text="Running").wait_for()
        assert [verb for _, verb, _ in desk.orders] == ["pause", "continue"]
        await page.get_by_role("button", name="Pause after this step").click()
        await page.get_by_role("button", name="Do not pause after this step").click()
        await page.get_by_role("button", name="Pause after this step", exact=True).wait_for()
        assert [verb for _, verb, _ in desk.orders[2:]] == ["pause", "continue"]
        desk.gate.hold(NOT_RECORDED)
        await page.get_by_text("The run is held: the disk takes no telemetry").wait_for()
        await page.get_by_text("It goes on when the disk takes what waits").wait_for()


async def test_stop_is_immediate_and_asks_nothing(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_text("Running", exact=True).wait_for()
        box = await page.locator("#stop").bounding_box()
        await page.mouse.move(box["x"] + 20, box["y"] + 20)
        desk.not_confirmed = (NotConfirmed(name="flap", since_ns=desk.clock.now_ns()),)
        await page.mouse.down()  # not even the release is waited for
        await until(lambda: desk.stops)
        notice = page.get_by_role("alert").filter(has_text="STOP, pressed at")
        assert re.search(r"pressed at \d\d:\d\d:\d\d", await notice.inner_text())
        await page.get_by_text("the stand is made safe").first.wait_for()
        await page.locator("#phase", has_text="Stopping").wait_for()
        await notice.get_by_text("Not yet confirmed safe: flap").wait_for()
        desk.not_confirmed = ()
        await notice.get_by_text(re.compile(r"Confirmed at \d\d:\d\d:\d\d: .*the flap is closed")).wait_for()


async def test_escape_twice_stops_and_once_does_not(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_text("Running", exact=True).wait_for()
        await page.keyboard.press("Escape")
        await page.wait_for_timeout(300)
        assert not desk.stops
        await page.keyboard.press("Escape")
        await until(lambda: desk.stops)


async def test_stop_goes_on_until_the_stand_has_heard_it(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_text("Running", exact=True).wait_for()
        tries = []

        async def deaf(route):
            tries.append(route)
            await (route.abort() if len(tries) < 3 else route.continue_())

        await page.route("**/run/stop", deaf)
        await page.locator("#stop").click()
        await page.get_by_text("NOT STOPPED").wait_for()
        await until(lambda: desk.stops)
        await page.get_by_text("the stand is made safe").first.wait_for()


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
async def test_nothing_ever_lies_over_stop(desk, size):
    """With a fault, a prompt, a pause and a question open, in every view and however far it is scrolled."""
    async with a_page(desk.chromium, desk.port, size=size) as page:
        await page.get_by_text("Running", exact=True).wait_for()
        desk.trip()
        desk.ask_operator("Roll the camera by 20 degrees")
        await page.get_by_text("The run waits for you").wait_for()
        await page.get_by_role("button", name="Look at it and reset").click()
        for view in VIEWS:
            await page.goto(f"http://127.0.0.1:{desk.port}/#{view}")
            await page.wait_for_timeout(200)
            for down in (0, 100_000):
                await page.mouse.wheel(0, down)
                assert await page.evaluate(STOP_IS_ON_TOP), view


async def test_a_fault_appears_and_is_cleared_only_after_it_was_shown(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_text("Running", exact=True).wait_for()
        desk.trip()
        await page.locator("#phase", has_text="Tripped").wait_for()
        alert = page.get_by_role("alert")
        assert "71.2" in await alert.inner_text()
        assert not await page.get_by_role("button", name="The cause is removed").is_visible()
        await page.get_by_role("button", name="Look at it and reset").click()
        await page.get_by_text("Readings now").wait_for()
        shown = await alert.inner_text()
        assert "°C" in shown
        assert "can be resumed" in shown
        assert not [word for word in ("abort", "false", "true", "ends itself") if word in shown]
        await page.get_by_role("button", name="The cause is removed").click()
        await page.locator("#phase", has_text="Running").wait_for()
        await alert.wait_for(state="detached")
        assert [verb for _, verb, _ in desk.orders] == ["reset"]


async def test_a_prompt_is_answered(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_text("Running", exact=True).wait_for()
        desk.ask_operator("Roll the camera by 20 degrees, <script>alert(1)</script>")
        await page.get_by_text("Roll the camera by 20 degrees, <script>").first.wait_for()
        await page.get_by_role("button", name="Done, go on").click()
        await page.get_by_text("The run waits for you").wait_for(state="detached")
        assert [verb for _, verb, _ in desk.orders] == ["continue"]


async def test_the_plan_is_a_time_line_whose_steps_are_left_out_and_extended(desk):
    async with a_page(desk.chromium, desk.port, "plan") as page:
        under_way = page.locator(".steps li[data-standing='under_way']")
        await under_way.wait_for()
        assert "soaked" in await under_way.inner_text()
        await page.get_by_role("button", name="+15 min: step 32").click()
        await until(lambda: desk.orders)
        assert desk.orders[-1][2]["by_s"] == 900
        await page.get_by_role("button", name="Skip: step 35").click()
        assert len(desk.orders) == 1  # it asks first
        await page.get_by_role("button", name="Leave it out").click()
        await until(lambda: len(desk.orders) == 2)
        await page.get_by_role("button", name="End the run").click()
        assert not desk.stops
        await page.get_by_role("group", name="End the run").get_by_role("button", name="End the run").click()
        await until(lambda: desk.stops)


async def test_the_steps_to_come_are_edited_in_rows_that_say_what_is_wrong(desk):
    async with a_page(desk.chromium, desk.port, "plan") as page:
        await page.get_by_role("button", name="Edit the steps to come").click()
        editor = page.get_by_role("group", name="Steps to come")
        await editor.get_by_text("4 steps, 1 h 03 min").wait_for()  # what the stand says of it as it is
        rows = editor.get_by_role("listitem")
        await editor.get_by_role("button", name="Remove: step 33").click()
        await rows.nth(0).get_by_label("chamber °C").fill("75")
        await editor.get_by_role("button", name="Duplicate: step 34").click()
        await editor.get_by_role("button", name="Use these steps").click()
        await rows.nth(0).get_by_text("a set-point of 75 degC").wait_for()
        assert not desk.edited
        assert await rows.nth(2).locator(".error").is_hidden()
        await rows.nth(0).get_by_label("chamber °C").fill("30")
        await rows.nth(3).get_by_text("5 frames at 30 °C").wait_for()
        label = rows.nth(3).get_by_label("chamber °C")  # follows from the steps before, and nobody types it
        assert (await label.input_value(), await label.is_editable()) == ("30", False)
        await rows.nth(1).get_by_label("duration, min").fill("10")
        await rows.nth(1).get_by_text("soak for 10 min").wait_for()
        await editor.get_by_role("button", name="Later: step 34").click()
        await editor.get_by_label("Kind of step to add").select_option("prompt")
        await editor.get_by_role("button", name="Add this step").click()
        await editor.get_by_role("button", name="Use these steps").click()
        await rows.nth(4).get_by_text("text: ").wait_for()
        await rows.nth(4).get_by_label("text").fill("Look at the lens")
        await editor.get_by_role("button", name="Use these steps").click()
        await until(lambda: desk.edited)
        await editor.wait_for(state="detached")
        assert desk.orders[-1][2] == {"from_index": 32, "steps": 5}
        assert "chamber_degC" not in desk.edited[3].parameters
        assert [step.kind for step in desk.edited] == ["start_chamber", "soak", "soak", "capture", "prompt"]


async def test_a_recipe_is_changed_in_its_form_and_queued_once(desk):
    async with a_page(desk.chromium, desk.port, "queue") as page:
        await page.get_by_text("Look at and change its parameters").click()
        frames = page.get_by_label("frames", exact=True).first
        assert await frames.input_value() == "3600"
        answered = asyncio.Event()

        async def late(route):
            await answered.wait()
            await route.continue_()

        await page.route("**/recipes/overnight", late)
        await page.get_by_label("recipe", exact=True).select_option("overnight")
        assert await frames.is_disabled()  # what is typed now would be lost when the answer comes
        answered.set()
        await frames.fill("120")
        await page.get_by_text("4 more, at their usual values").click()
        await page.get_by_label("cameras", exact=True).first.fill("lens A, lens B")
        await page.get_by_role("button", name="Add to the queue").click()
        await page.get_by_role("status").filter(has_text="is queued").wait_for()
        run = desk.queue[-1]
        order, _ = desk.requests[run.key]
        assert '"frames":120' in order.recipe_text
        assert '"cameras":["lens A","lens B"]' in order.recipe_text
        assert '"held_out_degC":[17,38]' in order.recipe_text
        await page.get_by_label("frames", exact=True).first.fill("-5")
        await page.get_by_role("button", name="Add to the queue").click()
        assert len(desk.queue) == 3  # the browser says what is wrong with the field
        assert await page.evaluate(BELOW_HEADER)


async def test_steps_and_parts_within_parts_have_fields_of_their_own(desk):
    async with a_page(desk.chromium, desk.port, "queue") as page:
        await page.get_by_label("recipe", exact=True).select_option("ramps")
        await page.get_by_text("Look at and change its parameters").click()
        await page.get_by_label("rate K per min").first.fill("0.7")
        await page.get_by_label("Kind of steps, one after another").select_option("soak")
        await page.get_by_role("button", name="Add to steps, one after another").click()
        await page.get_by_label("duration, min", exact=True).last.fill("1.5")
        await page.get_by_role("button", name="Add to the queue").click()
        await page.get_by_role("status").filter(has_text="is queued").wait_for()
        reported = json.loads(desk.requests[desk.queue[-1].key][0].recipe_text)
        assert reported["steps"][-1]["soak"]["duration_s"] == 90
        repeat = next(step["repeat"] for step in reported["steps"] if "repeat" in step)
        assert repeat["steps"][0]["ramp"]["rate_K_per_min"] == 0.7
        before = len(list(parse_document(find_packaged("recipes", "ramps").read_text(), Recipe, "ramps").plan()))
        assert len(list(parse_document(json.dumps(reported), Recipe, "sent").plan())) == before + 1


async def test_runs_are_moved_by_buttons_and_by_dragging_and_removed_after_a_question(desk):
    async with a_page(desk.chromium, desk.port, "queue") as page:
        await page.get_by_role("button", name="Later: run 3").click()
        await until(lambda: desk.orders)
        assert desk.orders[-1][2] == {"run": 3, "to": 2}
        rows = page.get_by_role("list", name="Runs to be done").locator("li")
        await rows.nth(1).drag_to(rows.nth(0))
        await until(lambda: len(desk.orders) == 2)
        assert desk.orders[-1][2] == {"run": 4, "to": 1}
        await page.get_by_role("button", name="Remove: run 4").click()
        await page.get_by_role("button", name="Remove it").click()
        await until(lambda: len(desk.queue) == 1)


async def test_a_run_that_has_tripped_is_resumed_once_that_is_cleared(desk):
    began_ns = desk.clock.now_ns()
    desk.queue = [
        QueuedRun(id=5, recipe="overnight", state="failed", added_ns=began_ns, session="20261122T180000Z-overnight")
    ]
    desk.trip()
    async with a_page(desk.chromium, desk.port, "queue") as page:
        await page.get_by_text("reset it, above; then a run can be resumed").wait_for()
        resume = page.get_by_role("button", name="Resume: run 5")
        assert await resume.is_disabled()
        await page.get_by_role("button", name="Look at it and reset").click()
        await page.get_by_role("button", name="The cause is removed").click()
        await resume.click()  # waits until it may
        await page.get_by_text("a run has the stand").wait_for()  # what this desk answers


async def test_devices_take_orders_only_between_runs(desk):
    async with a_page(desk.chromium, desk.port, "devices") as page:
        await page.get_by_text("Devices take no orders: a run owns the stand.").wait_for()  # once, for all of them
        assert await page.get_by_role("button", name="Open", exact=True).is_disabled()
        desk.is_idle = True
        flap = page.locator("section", has=page.get_by_role("heading", name="flap"))
        await flap.get_by_role("button", name="Open", exact=True).click()
        await until(lambda: desk.orders)
        assert desk.orders[-1][2] == {"device": "flap", "verb": "open"}


async def test_a_simulated_stand_is_broken_and_mended_and_a_real_one_is_not(desk):
    async with a_page(desk.chromium, desk.port, "devices") as page:
        faults = page.locator("section", has=page.get_by_role("heading", name="Faults on purpose"))
        await faults.get_by_label("What to break").select_option("flap.jam")
        await faults.get_by_text("feedback counts at which it stops").wait_for()
        await faults.get_by_label("value").fill("1500")
        await faults.get_by_label("for").fill("60")
        await faults.get_by_role("button", name="break").click()
        await faults.get_by_role("button", name="mend flap.jam").click()
        await until(lambda: len(desk.orders) == 2)
        broken, mended = (order[2] for order in desk.orders)
        assert broken == {"name": "flap.jam", "value": 1500, "for_s": 60.0}
        assert (mended["name"], mended["mend"]) == ("flap.jam", True)
        desk.is_simulated = False
        await page.locator("#simulated").wait_for(state="hidden")
    async with a_page(desk.chromium, desk.port, "devices") as page:
        await page.get_by_role("heading", name="What wears").wait_for()
        await page.get_by_role("button", name="Open", exact=True).wait_for()
        assert await page.get_by_role("heading", name="Faults on purpose").count() == 0


async def test_who_operates_may_not_clear_a_trip_nor_heat_by_hand_and_reads_which_role_may(desk):
    desk.is_idle = True
    known = {"name": "ann", "how": "token", "role": "operate"}
    async with a_page(desk.chromium, desk.port, "devices") as page:
        await page.route("**/api/v1/who", lambda route: route.fulfill(json=known))
        await page.reload()
        heat = page.locator("[data-verb=set] button")
        await page.locator("[data-verb=set] button:disabled").wait_for()
        assert await heat.get_attribute("title") == (
            "This needs the role commission. The token of ann has the role operate."
        )
        assert await page.locator("[data-verb=open] button").is_enabled()
        desk.trip()
        await page.get_by_role("button", name="Look at it and reset").click()
        await page.get_by_role("button", name="The cause is removed").wait_for()
        assert await page.get_by_role("button", name="The cause is removed").is_disabled()
        assert await page.locator("#stop").is_enabled()


async def test_who_may_only_look_gets_a_note_and_orders_nothing_but_stop(desk):
    async with a_page(desk.chromium, desk.port) as page:
        await page.get_by_text("Running", exact=True).wait_for()
        known = {"name": "wall", "how": "token", "role": "look"}
        await page.route("**/api/v1/who", lambda route: route.fulfill(json=known))
        await page.reload()
        await page.get_by_text("The token of wall may look and press STOP").wait_for()
        desk.trip()
        await page.get_by_role("button", name="Look at it and reset").click()
        for view in VIEWS:
            await page.goto(f"http://127.0.0.1:{desk.port}/#{view}")
            await page.wait_for_timeout(200)
            orders = page.locator("[data-order]")
            assert await orders.count() == await page.locator("[data-order]:disabled[title*=wall]").count()
            assert view != "plan" or await orders.count() > 5
        assert await page.get_by_role("button", name="The cause is removed").is_disabled()
        await page.locator("#stop").click()
        await until(lambda: desk.stops)
    assert [verb for _, verb, _ in desk.orders] == ["stop"]
