"""`stand submit` and `stand device`, against a desk in this process, over its socket and by TCP with a token."""

import asyncio
import json
from pathlib import Path

from typer.testing import CliRunner, Result

from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.test_interface_access import book, free_port
from thermostand.stand.commands.command_table import app as stand
from thermostand.stand.serving.api.listeners import Interface

TOKEN = "correct-horse-battery-staple"


async def invoke(*arguments: object) -> Result:
    return await asyncio.to_thread(CliRunner().invoke, stand, [str(argument) for argument in arguments])


async def test_a_run_is_submitted_once_for_each_key(tmp_path: Path):
    recipe = tmp_path / "cycle.yaml"
    recipe.write_text("name: night\n")
    async with serve_fake(FakeService(), tmp_path / "sessions") as desk:
        options = (tmp_path / "sessions",)
        assert (await invoke("submit", recipe, *options, "--key", "monday")).stdout == "1\n"
        assert (await invoke("submit", recipe, *options, "--key", "monday")).stdout == "1\n"
        other = await invoke("submit", "demo", *options, "--key", "monday")
        assert (other.exit_code, "used for another" in other.stderr) == (1, True)
        assert json.loads((await invoke("submit", "demo", *options, "--json")).stdout)["recipe"] == "demo"
    assert [run.recipe for run in desk.queue] == ["written", "demo"]


async def test_a_run_is_begun_at_an_address_and_what_is_of_this_machine_is_refused_with_it(tmp_path: Path):
    port, token = free_port(), tmp_path / "token"
    token.write_text(TOKEN)
    options = ["--url", f"http://127.0.0.1:{port}", "--token-file", str(token), "--detach"]
    async with serve_fake(FakeService(), tmp_path / "sessions", Interface(tmp_path, port=port, tokens=book())) as desk:
        begun = await asyncio.to_thread(CliRunner().invoke, stand, ["run", "demo", *options])
        assert begun.stdout == "run 1 is queued; `stand status` follows it\n"
        refused = await asyncio.to_thread(CliRunner().invoke, stand, ["run", "demo", *options, "--seed", "0"])
        assert (refused.exit_code, refused.stderr.startswith("error: --seed is")) == (2, True)
    assert [run.recipe for run in desk.queue] == ["demo"]


async def test_a_device_is_commanded_over_the_network(tmp_path: Path):
    port, token = free_port(), tmp_path / "token"
    token.write_text(TOKEN)
    interface = Interface(tmp_path, port=port, tokens=book())
    async with serve_fake(FakeService(), tmp_path / "sessions", interface) as desk:
        options = ("--url", f"http://127.0.0.1:{port}", "--token-file", token)
        assert (await invoke("device", *options)).stdout == "flap (flap)\n"
        assert (await invoke("device", "flap", "move", "to=0.5", "how=gently", *options)).stdout == "flap: move\n"
        nothing = await invoke("device", "lid", "open", *options)
        assert (nothing.exit_code, "no such device" in nothing.stderr) == (1, True)
        assert (await invoke("device", "flap", "move", "to", *options)).exit_code == 2
    who, verb, arguments = desk.orders[0]
    assert (who.name, who.how, verb) == ("rose", "token", "device")
    assert arguments == {"device": "flap", "verb": "move", "arguments": {"to": 0.5, "how": "gently"}}
