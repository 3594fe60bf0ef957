"""The pictures of the page in the documentation: `python -m tests.stand.page_pictures docs/pictures`."""

from __future__ import annotations

import asyncio
import sys
import tempfile
from contextlib import AsyncExitStack
from pathlib import Path

from PIL import Image

from tests.stand.browser import PHONE, a_page, browser
from tests.stand.page_service import free_port, serve_cycle
from thermostand.stand.serving.api_models import Requester

WIDE = (1280, 900)
COLOURS = 256


async def take(folder: Path) -> None:
    """Each in the view and the colours that show most."""
    port = free_port()
    with tempfile.TemporaryDirectory() as sessions:
        async with browser() as chromium, AsyncExitStack() as pages:
            async with serve_cycle(Path(sessions) / "sessions", port, with_frames=True) as desk:
                for name, view, size, scheme in (
                    ("page-now", "now", WIDE, "light"),
                    ("page-plan", "plan", (1280, 760), "dark"),
                    ("page-design", "queue", (1280, 760), "light"),
                    ("page-camera", "camera", WIDE, "dark"),
                    ("page-phone", "now", PHONE, "dark"),
                ):
                    async with a_page(chromium, port, view, size, scheme) as page:
                        await page.locator("#phase", has_text="Running").wait_for()
                        if view == "now":
                            await page.get_by_role("button", name="12 h").click()
                            await page.get_by_text("markers found").wait_for()
                        if view == "queue":
                            await page.locator(".course svg").first.wait_for()
                        if view == "plan":
                            await page.get_by_text("soak").first.wait_for()
                        await page.wait_for_timeout(2000)
                        await page.screenshot(path=folder / f"{name}.png")
                desk.trip()
                async with a_page(chromium, port, "now", WIDE, "dark") as page:
                    await page.get_by_role("button", name="Look at it and reset").click()
                    await page.wait_for_timeout(2000)
                    await page.screenshot(path=folder / "page-tripped.png")
                desk.reset(Requester(name="anna", how="loopback"))
                lost = await pages.enter_async_context(a_page(chromium, port, "plan", PHONE, "dark"))
                await lost.locator(".steps li", has_text="soak").first.wait_for()
            await lost.get_by_text("No connection to the stand").wait_for()
            await lost.screenshot(path=folder / "page-lost.png")
    for path in folder.glob("page-*.png"):
        Image.open(path).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    target = Path(sys.argv[1])
    target.mkdir(parents=True, exist_ok=True)
    asyncio.run(take(target))
