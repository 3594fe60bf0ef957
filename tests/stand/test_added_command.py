"""A command that is added outside of the program, as one method of a service, is found everywhere."""

import asyncio
from pathlib import Path
from typing import Any

import pytest
from pydantic import Field
from typer.testing import CliRunner

from tests.addresses import find_free_port
from tests.stand.browser import a_page, browser, needs_chromium
from tests.stand.fake_service import serve_fake
from tests.stand.secop_service import SecopService, node
from tests.stand.secop_talk import talking
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Event, Item
from thermostand.stand.commands.verbs import make_app
from thermostand.stand.serving.api.bridge import Bridge
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api_models import Conflict, Requester
from thermostand.stand.serving.client import find_session_server
from thermostand.stand.serving.commands import collect_commands, command
from thermostand.stand.serving.page_data import PageData
from thermostand.stand.serving.page_routes import PageRoutes


class FlushRequest(Document):
    """How long dry air is blown."""

    for_s: float = Field(gt=0, le=60, description="Seconds.")
    gently: bool = False


class Flushing(SecopService):
    """A service with one more command."""

    @command("/run/flush")
    async def flush(self, who: Requester, given: FlushRequest) -> str:
        """Blow dry air.

        Example: stand flush 5
        """
        if given.for_s > 30:
            raise Conflict("air for 30 s")
        return f"flushed for {given.for_s:g} s" + (", gently" if given.gently else "")


def test_it_is_in_the_table_with_its_words():
    found = collect_commands(Flushing)["flush"]
    assert (found.title, found.summary) == ("Flush", "Blow dry air.")
    assert "flush" not in collect_commands(SecopService)


async def test_it_has_a_route_and_is_in_the_document_and_in_the_page_s_table(tmp_path: Path):
    async with node(Flushing(), tmp_path):
        server = find_session_server(tmp_path / "cycle")

        async def ask(method: str, path: str, body: dict[str, object] | None = None) -> Any:
            return await asyncio.to_thread(server.request, method, path, body)

        answer = await ask("POST", "/api/v1/run/flush", {"for_s": 5, "gently": True})
        assert answer["verb"] == "flush"
        assert answer["text"] == "flushed for 5 s, gently"
        assert answer["seq"] > 0
        with pytest.raises(SessionError, match=r"for_s: .*equal to 60"):
            await ask("POST", "/api/v1/run/flush", {"for_s": 61})
        document = await ask("GET", "/openapi.json")
        entry = document["paths"]["/api/v1/run/flush"]["post"]
        assert entry["description"].startswith("Blow dry air")
        body = entry["requestBody"]["content"]["application/json"]["schema"]["$ref"].rpartition("/")[2]
        assert document["components"]["schemas"][body]["properties"]["for_s"]["maximum"] == 60
        (row,) = [each for each in await ask("GET", "/api/v1/commands") if each["name"] == "flush"]
        assert row == {
            "name": "flush",
            "title": "Flush",
            "text": "Blow dry air.",
            "method": "POST",
            "path": "/api/v1/run/flush",
            "role": "operate",
            "argument": FlushRequest.model_json_schema(),
        }


async def test_it_is_a_verb_of_the_command_line(tmp_path: Path):
    async with node(Flushing(), tmp_path):
        typed = ["flush", "5", str(tmp_path / "cycle"), "--gently"]
        done = await asyncio.to_thread(CliRunner().invoke, make_app(Flushing), typed)
        shown = CliRunner().invoke(make_app(Flushing), ["flush", "--help"], prog_name="stand")
    assert done.stdout == f"{tmp_path / 'cycle'}: flushed for 5 s, gently\n"
    assert "Example: stand flush 5" in shown.output
    assert "Seconds." in shown.output


async def test_secop_has_it_and_each_order_is_recorded_with_what_came_of_it(tmp_path: Path):
    desk, events = Flushing(), list[Event]()

    def follow(item: Item) -> None:
        if isinstance(item, Event) and item.kind == "command":
            events.append(item)

    desk.hub.subscribe(follow)
    async with node(desk, tmp_path) as port, talking(port) as talk:
        described = (await talk.asked("describe"))[2]["modules"]["run"]["accessibles"]["_flush"]
        assert described["datainfo"]["argument"]["type"] == "double"
        assert (await talk.asked("do run:_flush 5"))[0] == "done"
        assert (await talk.asked("do run:_flush 61"))[2][0] == "RangeError"
        assert (await talk.asked("do run:_flush 40"))[2][:2] == ["Impossible", "air for 30 s"]
    assert [each.text.partition(": ")[2] for each in events] == [
        "flush for_s=5.0",
        "flush for_s=40.0: refused: air for 30 s",
    ]
    assert [(each.data["verb"], each.data["arguments"], each.data["result"]) for each in events] == [
        ("flush", {"for_s": 5.0}, "done"),
        ("flush", {"for_s": 40.0}, "refused: air for 30 s"),
    ]


@needs_chromium
async def test_the_page_has_a_button_with_its_title_and_a_field_for_each_thing_that_it_takes(tmp_path: Path):
    desk, port = Flushing(), find_free_port()
    viewing = PageData(desk.hub, desk.clock, tmp_path, "")

    def make_routes(bridge: Bridge) -> Any:
        return PageRoutes(viewing)(bridge)

    interface = Interface(tmp_path, port=port, extra_routes=(make_routes,))
    async with (
        serve_fake(desk, tmp_path / "cycle", interface),
        browser() as windows,
        a_page(windows, port, "plan") as page,
    ):
        form = page.locator("form").filter(has=page.get_by_role("button", name="Flush", exact=True))
        await form.get_by_label("for, s").fill("5")
        await form.get_by_label("gently").check()
        await form.get_by_role("button", name="Flush").click()
        await page.get_by_text("flushed for 5 s, gently").wait_for()
        assert await page.get_by_role("button", name="Pause now").count() == 1  # called as its command is
    assert [(who.how, verb, arguments) for who, verb, arguments in desk.orders] == [
        ("loopback", "flush", {"for_s": 5.0, "gently": True})
    ]
