"""Recipes and sessions over the interface: what there is, what there is not, and a disk that hangs."""

import asyncio
import json
import threading
from pathlib import Path

import pytest

from tests.recording.full_session import record
from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.test_interface_access import ask, free_port
from thermostand.stand.serving.api import session_routes
from thermostand.stand.serving.api.bridge import NoAnswer
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.session_routes import REPORT, REPORT_CSP, DiskReader


async def test_a_disk_that_hangs_keeps_neither_the_interface_nor_the_process(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(session_routes, "_DISK_LIMIT_S", 0.1)
    hangs, disk = threading.Event(), DiskReader()
    with pytest.raises(NoAnswer, match="has not answered"):
        await disk.ask(lambda: hangs.wait(60))
    assert all(thread.daemon for thread in threading.enumerate() if thread.name == "disk")
    hangs.set()
    assert await disk.ask(lambda: 1) == 1
    with pytest.raises(ZeroDivisionError):
        await disk.ask(lambda: 1 / 0)


async def test_sessions_and_their_reports_are_read_and_links_are_not_followed(tmp_path: Path):
    folder, port = tmp_path / "sessions", free_port()
    folder.mkdir()
    await record(folder / "cycle")
    (folder / "cycle" / REPORT).write_text("<style>p {}</style><p>20 K")
    (folder / "linked").symlink_to(folder / "cycle")
    await record(tmp_path / "outside")
    (folder / "away").mkdir()
    (folder / "away" / "telemetry").symlink_to(tmp_path / "outside" / "telemetry")

    async def get(path: str) -> tuple[int, dict[str, str], bytes]:
        return await asyncio.to_thread(ask, port, "GET", f"/api/v1{path}")

    async with serve_fake(FakeService(), tmp_path / "cycle", Interface(folder, port=port)):
        listed = json.loads((await get("/sessions"))[2])
        found = next(entry for entry in listed if entry["name"] == "cycle")
        assert (found["frames"], found["files"], found["has_report"]) == (12, "sound", True)
        assert json.loads((await get("/sessions/cycle"))[2]) == found
        status, headers, text = await get("/sessions/cycle/report.html")
        assert (status, text) == (200, b"<style>p {}</style><p>20 K")
        assert headers["content-security-policy"] == REPORT_CSP
        assert (await get("/sessions/linked/report.html"))[0] == 404
        assert (await get("/sessions/away/report.html"))[0] == 404
        assert (await get("/sessions/gone"))[0] == 404
        names = [recipe["name"] for recipe in json.loads((await get("/recipes"))[2])]
        assert "thermal-cycle" in names
        assert json.loads((await get("/recipes/schema"))[2])["title"] == "Recipe"


async def test_without_a_folder_no_sessions_are_listed(tmp_path: Path):
    port = free_port()
    async with serve_fake(FakeService(), tmp_path / "cycle", Interface(tmp_path / "nowhere", port=port)):
        assert (await asyncio.to_thread(ask, port, "GET", "/api/v1/sessions"))[2] == b"[]"
