"""A real browser: Debian's chromium, driven by playwright, without a way to any other host."""

from __future__ import annotations

import shutil
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import pytest

CHROMIUM = shutil.which("chromium") or ""
needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="no chromium is installed (apt-get install chromium)")
ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)
DESKTOP, PHONE = (1440, 980), (390, 844)
# A broken connection and a request that the stand refuses are shown on the page, and by chromium in its console.
_EXPECTED = ("Failed to load resource", "WebSocket connection to")


@asynccontextmanager
async def browser() -> AsyncGenerator:
    """The browser."""
    from playwright.async_api import async_playwright

    async with async_playwright() as playwright:
        chromium = await playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        try:
            yield chromium
        finally:
            await chromium.close()


@asynccontextmanager
async def a_page(chromium, port: int, view: str = "now", size=DESKTOP, scheme="light") -> AsyncGenerator:
    """The stand's page. What goes wrong in it, a violation of its policy included, fails the test."""
    width, height = size
    options = {"viewport": {"width": width, "height": height}, "color_scheme": scheme, "has_touch": size is PHONE}
    context = await chromium.new_context(**options)
    page, errors = await context.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: message.type == "error" and errors.append(message.text))
    page.set_default_timeout(30_000)
    try:
        await page.goto(f"http://127.0.0.1:{port}/#{view}")
        yield page
        if unexpected := [error for error in errors if not error.startswith(_EXPECTED)]:
            pytest.fail(f"the page's console: {unexpected}")
    finally:
        await context.close()
