"""pyusb against fake devices behind a TCP connection, as the daemon meets them."""

import errno
import socket
import threading
from array import array
from collections.abc import Iterator

import pytest
import usb.core
import usb.util

from thermostand.drivers.sim.usb import ForwardingBackend, Stall, TimedOut, TransferFailed, UsbServer, get_backend


class Echo:
    """A device that gives back what it was asked: request type, request, value, offset."""

    vendor_id, product_id, release = 0x1FFB, 0x00C5, 0x0102

    def __init__(self, serial_number: str) -> None:
        self.strings = {1: "Maker", 2: "Echo", 3: serial_number}
        self.address = 1
        self.unplugged = False
        self.fails: TransferFailed | None = None
        self.written: list[tuple[int, int, int, int, bytes]] = []

    def control_transfer(
        self, request_type: int, request: int, value: int, index: int, length_or_data: int | bytes
    ) -> bytes:
        if self.fails is not None:
            raise self.fails
        if isinstance(length_or_data, int):
            return bytes([request_type, request, value & 0xFF, index & 0xFF])[:length_or_data]
        self.written.append((request_type, request, value, index, length_or_data))
        return b""


@pytest.fixture
def echo() -> Echo:
    return Echo("00123")


@pytest.fixture
def server(echo: Echo) -> Iterator[UsbServer]:
    server = UsbServer("127.0.0.1", 0, [echo, Echo("00456")])
    yield server
    server.close()


@pytest.fixture
def backend(server: UsbServer) -> Iterator[ForwardingBackend]:
    backend = get_backend(f"tcp:127.0.0.1:{server.port}")
    yield backend
    backend.finalize()


def found(backend: ForwardingBackend, serial_number: str = "00123") -> list[usb.core.Device]:
    devices = usb.core.find(find_all=True, backend=backend, idVendor=0x1FFB, idProduct=0x00C5)
    assert isinstance(devices, Iterator)
    return [device for device in devices if device.serial_number == serial_number]


def only(backend: ForwardingBackend) -> usb.core.Device:
    (device,) = found(backend)
    return device


def test_devices_are_found_by_vendor_and_serial_number(backend: ForwardingBackend) -> None:
    (device,) = found(backend, "00456")
    assert (device.manufacturer, device.product) == ("Maker", "Echo")
    assert backend.get_device_descriptor(backend.enumerate_devices()[0]).bcdDevice == 0x0102
    assert found(backend, "00789") == []
    assert usb.core.find(backend=backend, idVendor=0x0001) is None


def test_the_only_interface_is_vendor_specific_without_endpoints(backend: ForwardingBackend) -> None:
    device = only(backend)
    interfaces = list(device.get_active_configuration())
    assert [(part.bInterfaceClass, part.bNumEndpoints) for part in interfaces] == [(0xFF, 0)]


def test_a_read_and_a_write_reach_the_device(backend: ForwardingBackend, echo: Echo) -> None:
    device = only(backend)
    assert device.ctrl_transfer(0xC0, 0xE5, 3, 6, 53, 1600) == array("B", [0xC0, 0xE5, 3, 6])
    assert device.ctrl_transfer(0xC0, 0xE5, 3, 6, 2) == array("B", [0xC0, 0xE5])
    assert device.ctrl_transfer(0x40, 0x84, 3500, 0, None) == 0
    assert device.ctrl_transfer(0x40, 0xE6, 0, 5, b"\x01\x02") == 2
    assert echo.written == [(0x40, 0x84, 3500, 0, b""), (0x40, 0xE6, 0, 5, b"\x01\x02")]


@pytest.mark.parametrize(
    ("failure", "number"),
    [(Stall(), errno.EPIPE), (TimedOut(), errno.ETIMEDOUT), (TransferFailed(), errno.EIO)],
)
def test_a_failed_transfer_carries_its_errno(
    backend: ForwardingBackend, echo: Echo, failure: TransferFailed, number: int
) -> None:
    device = only(backend)
    echo.fails = failure
    with pytest.raises(usb.core.USBError) as raised:
        device.ctrl_transfer(0xC0, 0xE5, 0, 0, 53)
    assert raised.value.errno == number
    assert isinstance(raised.value, usb.core.USBTimeoutError) == (number == errno.ETIMEDOUT)
    echo.fails = None
    assert len(device.ctrl_transfer(0xC0, 0xE5, 0, 0, 53)) == 4


def test_an_unknown_string_stalls(backend: ForwardingBackend) -> None:
    with pytest.raises(usb.core.USBError) as raised:
        usb.util.get_string(only(backend), 9)
    assert raised.value.errno == errno.EPIPE


def test_silence_is_a_timeout_and_the_connection_is_not_used_again() -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    backend = get_backend(f"tcp:127.0.0.1:{listener.getsockname()[1]}")
    connections: list[socket.socket] = []

    def serve() -> None:
        for _ in range(2):  # the first connection lists one device, then nothing is answered any more
            connection, _ = listener.accept()
            connections.append(connection)
            connection.recv(65536)
            if len(connections) == 1:
                connection.sendall(
                    b'{"devices": [{"index": 0, "address": 1, "vendor_id": 1, "product_id": 2, "release": 3}]}\n'
                )

    thread = threading.Thread(target=serve)
    thread.start()
    handle = backend.enumerate_devices()[0]
    for _ in range(2):
        with pytest.raises(usb.core.USBTimeoutError):
            backend.ctrl_transfer(handle, 0xC0, 0xE5, 0, 0, array("B", bytes(4)), 50)
    thread.join()
    assert len(connections) == 2
    for end in (*connections, listener):
        end.close()
    backend.finalize()


@pytest.mark.parametrize("line", [b"nonsense\n", b"[]\n", b'{"op": "control"}\n', b'{"op": "control", "index": 7}\n'])
def test_a_wrong_request_is_answered_with_an_error(server: UsbServer, line: bytes) -> None:
    with socket.create_connection(("127.0.0.1", server.port)) as connection, connection.makefile("rb") as lines:
        connection.sendall(line)
        assert lines.readline() == b'{"error": -1}\n'


@pytest.mark.parametrize("address", ["", "tcp:7", "serial:/dev/x", "tcp:host:port", "tcp::7"])
def test_a_wrong_address_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match="tcp:HOST:PORT"):
        get_backend(address)
