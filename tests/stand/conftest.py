"""The browser and the session behind the page, and the session that commands are asked about."""

import asyncio
import shutil
from pathlib import Path

import pytest
import pytest_asyncio

from tests.recording.full_session import record
from tests.stand.browser import browser
from tests.stand.page_service import free_port, serve_cycle
from tests.stand.session_commands import COUNT


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def chromium():
    """One for all tests of a file: starting it takes longer than most of them."""
    async with browser() as windows:
        yield windows


@pytest_asyncio.fixture(loop_scope="module")
async def desk(tmp_path: Path, chromium):
    port = free_port()
    async with serve_cycle(tmp_path / "sessions", port) as opened:
        opened.port, opened.chromium = port, chromium
        yield opened


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of a session in a folder of sessions; not to be changed."""
    directory = tmp_path_factory.mktemp("sessions") / "20260101T180000Z-thermal_cycle"
    asyncio.run(record(directory, COUNT))
    return directory


@pytest.fixture
def session(whole: Path, tmp_path: Path) -> Path:
    """A copy of it that a test may spoil."""
    return Path(shutil.copytree(whole, tmp_path / "sessions" / whole.name))
