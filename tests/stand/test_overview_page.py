"""The view of all stands in a real browser."""

from pathlib import Path
from typing import Any

import pytest

from tests.stand.browser import a_page, needs_chromium
from tests.stand.page_service import serve_cycle
from tests.stand.test_interface_access import free_port
from tests.stand.test_overview import Remote, open_remote

pytestmark = [needs_chromium, pytest.mark.asyncio(loop_scope="module")]


async def test_the_page_shows_a_card_each_links_to_their_pages_and_stops_one(
    tmp_path: Path, chromium: Any, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "runtime").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    desk = Remote("cold", runs=True)
    async with open_remote(tmp_path / "cold", desk) as stand:
        port = free_port()
        async with serve_cycle(tmp_path / "cycle", port, stands=(stand,)), a_page(chromium, port, "stands") as page:
            card = page.locator(".card", has_text="cold").first
            await card.get_by_text("running", exact=True).wait_for()
            assert await card.get_by_role("link", name="cold").get_attribute("href") == stand.url
            await card.get_by_role("button", name="STOP cold").click()
            await card.get_by_text("the stand is made safe").wait_for()
            assert desk.stops == 1
