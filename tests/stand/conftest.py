"""The browser and the night behind the page, for the files that look at it."""

from pathlib import Path

import pytest_asyncio

from tests.stand.browser import browser
from tests.stand.page_desk import a_night, free_port


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def chromium():
    """One for all tests of a file: starting it takes longer than most of them."""
    async with browser() as windows:
        yield windows


@pytest_asyncio.fixture(loop_scope="module")
async def night(tmp_path: Path, chromium):
    port = free_port()
    async with a_night(tmp_path / "sessions", port) as desk:
        desk.port, desk.chromium = port, chromium
        yield desk
