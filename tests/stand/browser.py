"""A real browser: Debian's chromium, driven by playwright, without a way to any other host."""

from __future__ import annotations

import shutil
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import pytest

# The shell is the same browser without what no test looks at, and takes a third of the processor time.
CHROMIUM = shutil.which("chromium-headless-shell") or shutil.which("chromium") or ""
needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="no Chromium: apt-get install chromium-headless-shell")
ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)
DESKTOP, PHONE = (1440, 980), (390, 844)
VIEWS = ("now", "plan", "queue", "camera", "sessions", "devices", "stands")
# A broken connection and a request that the stand refuses are shown on the page, and by chromium in its console.
_EXPECTED = ("Failed to load resource", "WebSocket connection to")


class Windows:
    """Of a browser: one for each size of screen, whose tabs the pages are. To open a window, and to load the page in it
    as for the first time, takes it three times as long as a tab more."""

    def __init__(self, chromium) -> None:
        self._chromium = chromium
        self._opened: dict[tuple[int, int], Any] = {}

    async def of(self, size: tuple[int, int]):
        """The window of that size; it stays open."""
        if size not in self._opened:
            width, height = size
            viewport = {"width": width, "height": height}
            window = await self._chromium.new_context(viewport=viewport, has_touch=size is PHONE)
            await window.new_page()  # a window is closed with its last tab
            self._opened[size] = window
        return self._opened[size]


@asynccontextmanager
async def browser() -> AsyncGenerator[Windows]:
    """The browser."""
    from playwright.async_api import async_playwright

    async with async_playwright() as playwright:
        chromium = await playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        try:
            yield Windows(chromium)
        finally:
            await chromium.close()


@asynccontextmanager
async def a_page(windows: Windows, port: int, view: str = "now", size=DESKTOP, scheme="light") -> AsyncGenerator:
    """The stand's page, which finds nothing that another page has kept. What goes wrong in it, a violation of its
    policy included, fails the test."""
    window, origin, errors = await windows.of(size), f"http://127.0.0.1:{port}", []
    page = await window.new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: message.type == "error" and errors.append(message.text))
    page.set_default_timeout(30_000)
    try:
        kept = await window.new_cdp_session(page)
        await kept.send("Storage.clearDataForOrigin", {"origin": origin, "storageTypes": "all"})
        await kept.detach()
        await page.emulate_media(color_scheme=scheme)
        await page.goto(f"{origin}/#{view}")
        yield page
        if unexpected := [error for error in errors if not error.startswith(_EXPECTED)]:
            pytest.fail(f"the page's console: {unexpected}")
    finally:
        await page.close()
