"""`stand init`: the folder that it writes passes what `stand plan` checks, and nothing is overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from thermostand.drivers.wires.discovery import FoundCamera, SerialPort, UsbDevice
from thermostand.stand.commands import init_cli
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.order import load_order

FILES = {"stand.yaml", "recipe.yaml", "target.yaml", "README.md"}


def invoke(*arguments: object, answers: str | None = None) -> Result:
    return CliRunner().invoke(init_cli.app, [str(argument) for argument in arguments], input=answers)


def checked(folder: Path) -> StandConfig:
    """As `stand plan` reads it."""
    order = load_order(str(folder / "recipe.yaml"), str(folder / "stand.yaml"))
    assert list(order.recipe.plan())
    return order.config


def test_the_simulated_stand_needs_no_answers(tmp_path: Path):
    done = invoke(tmp_path / "mine", "--simulated")
    assert (done.exit_code, {path.name for path in (tmp_path / "mine").iterdir()}) == (0, FILES)
    config = checked(tmp_path / "mine")
    assert (config.name, config.simulation is not None) == ("mine", True)


def test_options_say_what_is_connected_and_what_is_not_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    async def answer(addresses: list[str], wait_s: float) -> tuple[FoundCamera, ...]:
        return (FoundCamera(addresses[0], "A maker", "a model", "1.0", "00351210"),)

    monkeypatch.setattr(init_cli, "find_cameras", answer)
    options = ("--bus", "/dev/serial/by-id/x", "--camera", "10.0.0.7", "--axis", "linear=/dev/ximc/00001007:4103")
    done = invoke(tmp_path, "--name", 'a "stand"', "--no-ask", *options)
    assert done.exit_code == 0, done.stderr
    config = checked(tmp_path)
    assert (config.name, config.bus.address if config.bus else "") == ('a "stand"', "serial:/dev/serial/by-id/x")
    camera = config.cameras["camera"].model_dump()
    assert (str(camera["address"]), camera["serial_number"]) == ("10.0.0.7", "00351210")
    assert (config.axes["linear"].serial_number, config.axes["rotary"].serial_number) == (4103, 4102)
    assert "flap.serial_number is still" in done.stderr
    assert "axes.rotary is still" in done.stderr
    assert "the camera is" not in done.stderr


def test_at_a_terminal_it_asks_among_what_is_connected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    ports = (
        SerialPort("/dev/serial/by-id/one", "an adapter", ""),
        SerialPort("/dev/serial/by-id/two", "another", ""),
        SerialPort("/dev/ximc/00001007", "a stage", ""),
    )
    monkeypatch.setattr(init_cli, "_is_terminal", lambda: True)
    monkeypatch.setattr(init_cli, "list_serial_ports", lambda: ports)
    monkeypatch.setattr(init_cli, "list_usb_devices", lambda: (UsbDevice(0x1FFB, 0xB7, "the flap", "00001234"),))
    done = invoke(
        tmp_path / "mine", answers="1\n0\n2\n1\n\n"
    )  # linear, rotary, bus, flap, camera; no gateway, as there is a bus
    assert done.exit_code == 0, done.stderr
    config = checked(tmp_path / "mine")
    assert config.bus is not None
    assert config.bus.address == "serial:/dev/serial/by-id/two"
    assert (config.axes["linear"].serial_number, config.flap.serial_number) == (0x1007, "00001234")


@pytest.mark.parametrize("answer", ["10.0.0.9", "tcp:10.0.0.9:502", "10.0.0.9:502"])
def test_it_asks_for_a_gateway_where_no_adapter_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str):
    monkeypatch.setattr(init_cli, "_is_terminal", lambda: True)
    monkeypatch.setattr(init_cli, "list_serial_ports", tuple)
    monkeypatch.setattr(init_cli, "list_usb_devices", tuple)
    asked = invoke(tmp_path / "asked", answers=f"{answer}\n\n")  # gateway, camera
    given = invoke(tmp_path / "given", "--no-ask", "--bus", answer)
    assert (asked.exit_code, given.exit_code) == (0, 0), asked.stderr
    for folder in ("asked", "given"):
        config = checked(tmp_path / folder)
        assert config.bus is not None
        assert config.bus.address == "tcp:10.0.0.9:502"
        assert "bus.address" not in given.stderr


@pytest.mark.parametrize("more", [("--simulated",), ("--no-ask",)])
def test_nothing_in_it_is_a_path_of_this_computer(tmp_path: Path, more: tuple[str, ...]):
    assert invoke(tmp_path / "mine", *more).exit_code == 0
    texts = [path.read_text() for path in (tmp_path / "mine").iterdir()]
    named = {line.partition("$schema=")[2] for text in texts for line in text.splitlines() if "$schema=" in line}
    assert named == {"schema/stand.json", "schema/recipe.json", "schema/target.json"}
    assert not [text for text in texts if str(Path(init_cli.__file__).parents[2]) in text]


def test_no_existing_file_is_overwritten(tmp_path: Path):
    (tmp_path / "recipe.yaml").write_text("mine")
    refused = invoke(tmp_path, "--simulated")
    assert (refused.exit_code, "is there already" in refused.stderr) == (2, True)
    assert [path.name for path in tmp_path.iterdir()] == ["recipe.yaml"]
    assert (tmp_path / "recipe.yaml").read_text() == "mine"


@pytest.mark.parametrize(
    "options", [("--bus", "a b:c:d"), ("--simulated", "--bus", "x"), ("--axis", "linear"), ("--axis", "up=/dev/x:1")]
)
def test_options_that_mean_nothing_are_refused(tmp_path: Path, options: tuple[str, ...]):
    assert invoke(tmp_path / "new", "--no-ask", *options).exit_code == 2
    assert not (tmp_path / "new").exists()


def test_a_file_in_the_way_and_a_wrong_address_are_reported(tmp_path: Path):
    (tmp_path / "file").write_text("mine")
    refused = invoke(tmp_path / "file", "--no-ask")
    assert (refused.exit_code, "choose another folder" in refused.stderr) == (2, True)
    refused = invoke(tmp_path / "new", "--no-ask", "--bus", "a b:c:d")
    assert "stand.yaml: bus.address: " in refused.stderr
    assert "/tmp" not in refused.stderr.partition("stand.yaml")[0]
