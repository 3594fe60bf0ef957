"""A session is designed on the page, in a real browser: what it will do is seen before it is queued."""

import asyncio
import re

import pytest

from tests.stand.browser import DESKTOP, a_page, needs_chromium
from thermostand.foundation.documents import parse_document
from thermostand.stand.config.recipe import Recipe

pytestmark = [needs_chromium, pytest.mark.asyncio(loop_scope="module")]


async def until(check, timeout_s=30.0):
    """Wait for what another process does."""
    async with asyncio.timeout(timeout_s):
        while not check():
            await asyncio.sleep(0.05)


async def choose(page, recipe):
    async with page.expect_response(lambda each: each.request.post_data == f'{{"recipe":"{recipe}"}}') as answer:
        await page.get_by_label("recipe", exact=True).select_option(recipe)
    return await (await answer.value).json()


async def test_what_a_session_will_do_follows_what_is_typed(desk):
    desk.queue = []
    async with a_page(desk.chromium, desk.port, "queue", DESKTOP) as page:
        before = await choose(page, "thermal-cycle")
        await page.get_by_text("it begins at once").wait_for()
        assert await page.locator("div.course circle.capture").count() == len(before["course"]["captures"]) == 49
        await page.get_by_text("Look at and change its parameters").click()
        async with page.expect_response("**/previews") as answer:
            await page.get_by_label("soak, min", exact=True).fill("30")
        after = await (await answer.value).json()
        # 48 soaks of 15 min less.
        assert after["duration_s"] == pytest.approx(before["duration_s"] - 48 * 900)
        assert (
            parse_document(after["recipe_text"], Recipe, "it").experiments[0].model_dump()["thermal_cycle"]["soak_s"]
            == 1800
        )
        async with page.expect_response("**/previews") as answer:
            await page.get_by_label("set points °C").fill("31, 75")
        assert (await answer.value).status == 422
        await page.locator(".lacks .error").wait_for()
        assert await page.get_by_role("button", name="Add to the queue").is_disabled()


async def test_a_level_is_moved_with_keys_and_by_dragging(desk):
    async with a_page(desk.chromium, desk.port, "queue", DESKTOP) as page:
        await choose(page, "thermal-cycle")
        level = page.get_by_role("slider", name="set-point 48 °C")
        async with page.expect_response("**/previews") as answer:
            await level.press("ArrowUp")
        moved = (await (await answer.value).json())["recipe"]["experiments"][0]["thermal_cycle"]
        assert 48 not in moved["set_points_degC"]
        assert moved["set_points_degC"].count(48.5) == 2
        assert 48.5 in moved["held_out_degC"]
        level = page.get_by_role("slider", name="set-point 48.5 °C")
        box = await level.bounding_box()
        await page.mouse.move(box["x"] + 5, box["y"] + 6)
        await page.mouse.down()
        await page.mouse.move(box["x"] + 5, box["y"] - 10)
        async with page.expect_response("**/previews") as answer:
            await page.mouse.up()
        highest = max(
            (await (await answer.value).json())["recipe"]["experiments"][0]["thermal_cycle"]["set_points_degC"]
        )
        assert highest > 48.5


async def test_a_recipe_is_written_as_yaml_saved_rehearsed_and_removed(desk):
    async with a_page(desk.chromium, desk.port, "queue", DESKTOP) as page:
        await choose(page, "demo")
        from playwright.async_api import expect

        await page.get_by_text("As YAML").click()
        text = page.get_by_label("The recipe as YAML")
        await expect(text).to_have_value(re.compile("thermal_cycle"))
        async with page.expect_response("**/previews"):
            await text.fill(
                (await text.input_value()).replace("name: demo", "name: mine").replace("frames: 16", "frames: 17")
            )
        await page.get_by_text("Look at and change its parameters").click()
        # Two views of one recipe.
        await expect(page.get_by_label("frames", exact=True).first).to_have_value("17")
        name = page.get_by_label("name", exact=True)
        await name.fill("Mein Nachtlauf Ö2")
        await name.blur()
        assert await name.input_value() == "mein-nachtlauf-o2"  # made valid, not refused
        await page.get_by_role("button", name="Save as a recipe").click()
        await page.get_by_text("saved as mein-nachtlauf-o2").wait_for()
        saved = desk.sessions / "recipes" / "mein-nachtlauf-o2.yaml"
        assert parse_document(saved.read_text(), Recipe, "saved").name == "mein-nachtlauf-o2"
        await page.get_by_role("button", name="Rehearse").click()
        await until(lambda: desk.rehearsed.get("name") == "mein-nachtlauf-o2")
        await page.get_by_role("button", name="Remove this recipe").click()
        await until(lambda: not saved.exists())


async def test_a_run_that_ended_early_is_resumed_on_the_plan_with_what_is_done_again(desk):
    desk.is_idle = True
    desk.queue[0] = desk.queue[0].model_copy(update={"state": "interrupted", "session": "20261122T180000Z-validation"})
    async with a_page(desk.chromium, desk.port, "plan", DESKTOP) as page:
        desk.plan = lambda: ()
        desk.resume = lambda who, given: given.session
        await page.get_by_role("button", name="Resume").click()
        await until(lambda: desk.orders)
        assert desk.orders[-1][1:] == ("resume", {"session": "20261122T180000Z-validation"})
