"""Byte links over pseudo-terminals and TCP: what comes through, and what is reported when nothing does."""

import os
import socket
import time
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.drivers.wires.link import ByteLink, SerialSettings, open_link
from thermostand.foundation.addresses import set_display_address
from thermostand.foundation.errors import Unreachable

LINE = SerialSettings(baud=115200, stopbits=2)


class Echo:
    def feed(self, data: bytes) -> bytes:
        return data


@pytest.fixture(params=["serial", "tcp"])
def wire(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[PtyWire | TcpWire]:
    if request.param == "serial":
        wire: PtyWire | TcpWire = PtyWire(tmp_path / "port", Echo(), LinkFaults())
    else:
        wire = TcpWire("127.0.0.1", 0, Echo, LinkFaults())
    yield wire
    wire.close()


@pytest.fixture
def address(wire: PtyWire | TcpWire, tmp_path: Path) -> str:
    return f"tcp:127.0.0.1:{wire.port}" if isinstance(wire, TcpWire) else f"serial:{tmp_path / 'port'}"


def linked(server: socket.socket) -> ByteLink:
    return open_link("stage", f"tcp:127.0.0.1:{server.getsockname()[1]}", LINE)


@contextmanager
def bounded() -> Generator[None]:
    begun_s = time.monotonic()
    yield
    assert time.monotonic() - begun_s < 10  # a wait without a bound takes for ever


def read_all(link: ByteLink, size: int) -> bytes:
    received = b""
    while len(received) < size and (data := link.read(2.0)):
        received += data
    return received


def test_bytes_come_back_in_order_and_zeros_are_bytes_too(address: str) -> None:
    with closing(open_link("stage", address, LINE)) as link:
        data = bytes(range(256)) * 4
        link.write(data)
        assert read_all(link, len(data)) == data


def test_a_silent_wire_gives_nothing_after_the_time_out_and_at_once_without_one(address: str) -> None:
    with closing(open_link("stage", address, LINE)) as link:
        assert link.read(0.0) == b""
        begun_s = time.monotonic()
        assert link.read(0.05) == b""
        assert time.monotonic() - begun_s >= 0.045


def test_a_wire_that_is_taken_away_says_where_it_was(address: str, wire: PtyWire | TcpWire) -> None:
    with closing(open_link("stage", address, LINE)) as link:
        link.write(b"once")
        assert read_all(link, 4) == b"once"
        wire.close()
        with pytest.raises(Unreachable, match=r"^stage: (\S*port is gone|127\.0\.0\.1:\d+ (is gone|closed))"):
            link.read(2.0)


def test_a_link_may_be_closed_twice(address: str) -> None:
    link = open_link("stage", address, LINE)
    link.close()
    link.close()


def test_a_second_opener_of_a_serial_port_learns_that_it_is_taken(tmp_path: Path) -> None:
    wire = PtyWire(tmp_path / "port", Echo(), LinkFaults())
    address = f"serial:{tmp_path / 'port'}"
    with closing(wire), closing(open_link("stage", address, LINE)) as first:
        with pytest.raises(Unreachable, match=rf"^other: cannot open {tmp_path}/port: another program"):
            open_link("other", address, LINE)
        first.write(b"mine")
        assert read_all(first, 4) == b"mine"


@pytest.mark.parametrize("stated", ["serial:/dev/ximc/00001005", "tcp:moxa:4001"])
def test_a_simulated_port_is_named_as_the_stands_file_does(tmp_path: Path, stated: str) -> None:
    how, _, name = stated.partition(":")
    free = {"serial": f"serial:{tmp_path / 'anywhere'}", "tcp": "tcp:127.0.0.1:1"}[how]
    set_display_address(free, stated)
    with pytest.raises(Unreachable) as caught:
        open_link("stage", free, LINE)
    assert name in str(caught.value)
    assert free.removeprefix(f"{how}:") not in str(caught.value)


def test_a_missing_port_is_reported_as_such(tmp_path: Path) -> None:
    with pytest.raises(Unreachable, match=rf"^stage: cannot open {tmp_path}/none: No such file"):
        open_link("stage", f"serial:{tmp_path / 'none'}", LINE)


def test_what_is_no_terminal_is_no_port(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(Unreachable, match=r"^stage: cannot open .*/file: "):
        open_link("stage", f"serial:{tmp_path / 'file'}", LINE)


def test_a_refused_tcp_connection_is_reported_as_such() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(Unreachable, match=rf"^stage: cannot connect to 127\.0\.0\.1:{port}: Connection refused$"):
        open_link("stage", f"tcp:127.0.0.1:{port}", LINE)


def test_a_tcp_peer_that_hangs_up_is_reported_as_such() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, closing(linked(server)) as link:
        server.accept()[0].close()
        with pytest.raises(Unreachable, match=r"^stage: 127\.0\.0\.1:\d+ closed the connection$"):
            link.read(2.0)


def test_a_serial_peer_that_takes_no_bytes_does_not_hold_the_writer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("thermostand.drivers.wires.link._WRITE_S", 0.1)
    master, slave = os.openpty()
    link = open_link("stage", f"serial:{os.ttyname(slave)}", LINE)
    with closing(link), bounded(), pytest.raises(Unreachable, match="is gone"):
        link.write(bytes(1_000_000))
    os.close(master)
    os.close(slave)


def test_a_tcp_peer_that_takes_no_bytes_does_not_hold_the_writer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("thermostand.drivers.wires.link._WRITE_S", 0.1)
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        closing(linked(server)) as link,
        bounded(),
        pytest.raises(Unreachable, match="is gone"),
    ):
        link.write(bytes(50_000_000))


@pytest.mark.parametrize(
    "address", ["", "serial:", "/dev/ttyACM0", "tcp:host", "tcp::1820", "tcp:host:99999", "udp:h:1"]
)
def test_an_address_that_is_none_is_a_configuration_error(address: str) -> None:
    with pytest.raises(ValueError, match=r"^expected (serial:PATH|tcp:HOST:PORT)"):
        open_link("stage", address, LINE)
