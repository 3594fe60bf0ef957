"""What is connected: cameras asked at their addresses, USB devices as the kernel lists them, and the command."""

import asyncio
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from thermostand.drivers.sim.gige.camera_registers import ControlChannel, Registers
from thermostand.drivers.sim.gige.genicam import make_features
from thermostand.drivers.sim.gige.gvcp import GvcpCommand, GvcpRequest
from thermostand.drivers.wires.discovery import GVCP_PORT, FoundCamera, decode_answer, find_cameras, list_usb_devices
from thermostand.stand.commands.command_table import app

HERE, SILENT = "127.0.0.91", "127.0.0.92"


class Device:
    def before_read(self, address, count):
        pass

    after_write = resend = control_ended = before_read


def channel() -> ControlChannel:
    return ControlChannel(Registers(make_features(64, 48, "SN 7"), HERE, "SN 7"), Device())  # pyright: ignore[reportArgumentType]


def answer() -> bytes:
    return channel().feed(GvcpRequest(GvcpCommand.DISCOVERY, 0xFFFF).encode(), ("127.0.0.1", 4), 0.0) or b""


class Answering(asyncio.DatagramProtocol):
    """A simulated camera's control channel at its address."""

    def __init__(self) -> None:
        self.channel, self.asked = channel(), 0

    def connection_made(self, transport):
        self.transport = transport

    def datagram_received(self, data, addr):
        self.asked += 1
        self.transport.sendto(b"junk", addr)
        self.transport.sendto(self.channel.feed(data, addr, 0.0), addr)


def check_camera(found: FoundCamera) -> None:
    assert (found.address, found.make, found.serial) == (HERE, "Thermostand", "SN 7")
    assert found.model
    assert found.firmware


def test_an_answer_is_decoded_and_anything_else_is_nothing():
    found = decode_answer(answer() + b"trailing")
    assert found is not None
    check_camera(found)
    whole = answer()
    assert [decode_answer(whole[:length]) for length in range(0xE8)] == [None] * 0xE8
    assert decode_answer(b"\x80\x06" + whole[2:]) is None


@given(st.binary(max_size=300))
def test_no_datagram_is_an_error(datagram: bytes):
    decode_answer(datagram)
    decode_answer(answer()[:8] + datagram)


async def test_a_camera_is_found_where_it_is_asked_and_nowhere_else():
    camera = Answering()
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: camera, local_addr=(HERE, GVCP_PORT)
    )
    (found,) = await find_cameras([SILENT, HERE], 0.2)
    check_camera(found)
    assert camera.asked == 2
    assert await find_cameras([SILENT], 0.1) == ()
    transport.close()


def test_usb_devices_are_the_kernels_without_hubs(tmp_path: Path):
    for name, texts in {
        "1-1": {"idVendor": "1ffb", "idProduct": "00c5", "serial": "00351210", "bDeviceClass": "ef"},
        "1-2": {"idVendor": "046d", "idProduct": "c31c", "manufacturer": "Maker", "product": "Keyboard"},
        "usb1": {"idVendor": "1d6b", "idProduct": "0002", "bDeviceClass": "09"},
        "1-1:1.0": {},
    }.items():
        (tmp_path / name).mkdir()
        for file, text in texts.items():
            (tmp_path / name / file).write_text(text + "\n")
    flap, keyboard = list_usb_devices(tmp_path)
    assert (flap.vendor, flap.product, flap.serial) == (0x1FFB, 0xC5, "00351210")
    assert "flap" in flap.what
    assert keyboard.what == "Maker Keyboard"


def test_the_command_says_what_it_found_and_what_it_did_not_ask_for():
    result = CliRunner().invoke(app, ["devices"])
    assert result.exit_code == 0, result.output
    assert "cameras: not asked for; `--ask ADDRESS`" in result.stdout
    result = CliRunner().invoke(app, ["devices", "--ask", SILENT, "--wait-s", "0.1"])
    assert f"has answered at {SILENT}" in result.stdout
    found = json.loads(CliRunner().invoke(app, ["devices", "--json"]).stdout)
    assert found["cameras"] == []
    assert set(found) == {"serial", "usb", "cameras"}


@pytest.mark.parametrize("address", ["300.1.1.1", "a host that is none"])
def test_an_address_that_is_none_is_refused_in_a_sentence(address: str):
    result = CliRunner().invoke(app, ["devices", "--ask", address, "--wait-s", "0.1"])
    assert result.exit_code == 2
    assert address in result.stderr
