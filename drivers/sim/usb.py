"""USB without a bus: a server with the fake devices, and the pyusb backend in the daemon that forwards to it.

One TCP connection, one JSON object per line each way. The daemon's configuration names this module as the flap's
backend, so that the driver's code is the same for a fake and a real device.

    {"op": "list"}                                   -> {"devices": [{"index": 0, "address": 1, "vendor_id": ...}]}
    {"op": "control", "index": 0, "address": 1, "request_type": 192, "request": 229, "value": 0, "offset": 0,
     "length": 53}  (or "data": hex for a write)     -> {"data": hex}, or {"error": libusb's number}
"""

# pyright: reportIncompatibleMethodOverride=false
# (usb.backend.IBackend has no annotations: its methods, which only raise, are taken to return None)

from __future__ import annotations

import errno
import json
import socket
import threading
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Protocol

from usb.backend import IBackend
from usb.core import USBError, USBTimeoutError

from thermostand.drivers.sim.wire import LineEngine, LinkFaults, TcpWire
from thermostand.foundation.addresses import parse_tcp_address

GET_DESCRIPTOR_IN, GET_DESCRIPTOR, STRING_DESCRIPTOR = 0x80, 6, 3
LANGUAGES = b"\x04\x03\x09\x04"  # one language: English (United States)

IO_ERROR, NO_DEVICE, TIMEOUT, PIPE_ERROR = -1, -4, -7, -9
# libusb's number -> errno and text, as pyusb's own libusb backend gives them.
ERRORS: Mapping[int, tuple[int, str]] = {
    IO_ERROR: (errno.EIO, "Input/Output Error"),
    NO_DEVICE: (errno.ENODEV, "No such device (it may have been disconnected)"),
    TIMEOUT: (errno.ETIMEDOUT, "Operation timed out"),
    PIPE_ERROR: (errno.EPIPE, "Pipe error"),
}
LIST_TIMEOUT_S = 2.0


class TransferFailed(Exception):
    """A control transfer that got no answer; `code` is libusb's error number."""

    code = IO_ERROR


class Stall(TransferFailed):
    """The device declines the request."""

    code = PIPE_ERROR


class TimedOut(TransferFailed):
    """The device does not answer in time."""

    code = TIMEOUT


class FakeUsbDevice(Protocol):
    """What the server asks of a fake device. `address` changes when it is plugged in again; `strings` are its string
    descriptors: 1 manufacturer, 2 product, 3 serial number."""

    vendor_id: int
    product_id: int
    release: int
    address: int

    @property
    def strings(self) -> Mapping[int, str]:
        """String descriptors by index."""
        ...

    @property
    def unplugged(self) -> bool:
        """Whether the device is not on the bus."""
        ...

    def control_transfer(
        self, request_type: int, request: int, value: int, index: int, length_or_data: int | bytes
    ) -> bytes:
        """Return what was read, b"" for a write; raises TransferFailed."""
        ...


class UsbServer:
    """The simulator's end: lists the plugged-in `devices` and carries control transfers to them."""

    def __init__(self, host: str, port: int, devices: Sequence[FakeUsbDevice]) -> None:
        self._devices = devices
        self._wire = TcpWire(host, port, lambda: LineEngine(self._answer), LinkFaults())
        self.port, self.address = self._wire.port, self._wire.address

    def close(self) -> None:
        """Stop listening and drop every connection."""
        self._wire.close()

    def _answer(self, line: bytes) -> bytes:
        return json.dumps(self._result(line)).encode()

    def _result(self, line: bytes) -> dict[str, object]:
        try:
            request = json.loads(line)
            return {"devices": self._listing()} if request["op"] == "list" else {"data": self._control(request).hex()}
        except TransferFailed as failure:
            return {"error": failure.code}
        except (ValueError, LookupError, TypeError):
            return {"error": IO_ERROR}

    def _listing(self) -> list[dict[str, int]]:
        return [
            {
                "index": index,
                "address": device.address,
                "vendor_id": device.vendor_id,
                "product_id": device.product_id,
                "release": device.release,
            }
            for index, device in enumerate(self._devices)
            if not device.unplugged
        ]

    def _control(self, request: Mapping[str, object]) -> bytes:
        numbers = {key: value for key, value in request.items() if isinstance(value, int)}
        device = self._devices[numbers["index"]]
        if device.unplugged or device.address != numbers["address"]:
            raise _Gone
        request_type, number, value = numbers["request_type"], numbers["request"], numbers["value"]
        if (request_type, number, value >> 8) == (GET_DESCRIPTOR_IN, GET_DESCRIPTOR, STRING_DESCRIPTOR):
            return _string(device, value & 0xFF)[: numbers["length"]]
        length_or_data = numbers["length"] if "length" in numbers else bytes.fromhex(str(request["data"]))
        return device.control_transfer(request_type, number, value, numbers["offset"], length_or_data)


class _Gone(TransferFailed):
    """The device was unplugged, even if it has come back since."""

    code = NO_DEVICE


def _string(device: FakeUsbDevice, index: int) -> bytes:
    """A string descriptor, USB 2.0 section 9.6.7."""
    if index == 0:
        return LANGUAGES
    if index not in device.strings:
        raise Stall
    text = device.strings[index].encode("utf-16-le")
    return bytes([len(text) + 2, STRING_DESCRIPTOR]) + text


def get_backend(address: str) -> ForwardingBackend:
    """A pyusb backend that finds the devices of the simulator at `address`, "tcp:HOST:PORT"; ValueError else."""
    return ForwardingBackend(*parse_tcp_address(address))


@dataclass(frozen=True, slots=True)
class Handle:
    """A device as it was listed; useless once it has been unplugged."""

    index: int
    address: int
    vendor_id: int
    product_id: int
    release: int


class ForwardingBackend(IBackend):
    """pyusb's view of the simulated bus: one interface, no endpoints, control transfers only. Method names and
    results are those of usb.backend.IBackend."""

    def __init__(self, host: str, port: int) -> None:
        self._place = (host, port)
        self._connection: socket.socket | None = None
        self._lock = threading.Lock()

    def enumerate_devices(self) -> list[Handle]:
        """Every device that is plugged in; none when the simulator does not answer."""
        try:
            listing = self._ask({"op": "list"}, LIST_TIMEOUT_S)["devices"]
        except USBError:
            return []
        return [Handle(**fields) for fields in listing] if isinstance(listing, list) else []

    def get_parent(self, dev: Handle) -> None:
        """Return None: the simulated bus has no hubs."""

    def get_device_descriptor(self, dev: Handle) -> SimpleNamespace:
        """USB 2.0 table 9-8, and where the device is."""
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0xEF, bDeviceSubClass=2, bDeviceProtocol=1,
            bMaxPacketSize0=8, idVendor=dev.vendor_id, idProduct=dev.product_id, bcdDevice=dev.release,
            iManufacturer=1, iProduct=2, iSerialNumber=3, bNumConfigurations=1,
            address=dev.address, bus=1, port_number=dev.index + 1, port_numbers=(dev.index + 1,), speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: Handle, config: int) -> SimpleNamespace:
        """USB 2.0 table 9-10."""
        if config > 0:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=18, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=50, extra_descriptors=b"",
        )  # fmt: skip

    def get_interface_descriptor(self, dev: Handle, intf: int, alt: int, config: int) -> SimpleNamespace:
        """USB 2.0 table 9-12: the native interface."""
        if intf > 0 or alt > 0 or config > 0:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=0,
            bInterfaceClass=0xFF, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=b"",
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: Handle, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Raise IndexError: the simulated interfaces have no endpoint of that number."""
        raise IndexError(ep)

    def open_device(self, dev: Handle) -> Handle:
        """The device itself; USBError ENODEV when it is gone."""
        if dev not in self.enumerate_devices():
            raise _usb_error(NO_DEVICE)
        return dev

    def close_device(self, dev_handle: Handle) -> None:
        """Lets go of the connection; the next request makes a new one."""
        with self._lock:
            self._drop()

    def set_configuration(self, dev_handle: Handle, config_value: int) -> None:
        """Accept any configuration: the simulated devices have one."""

    def get_configuration(self, dev_handle: Handle) -> int:
        """The only one."""
        return 1

    def claim_interface(self, dev_handle: Handle, intf: int) -> None:
        """Accept the claim: no other driver contends for it."""

    def release_interface(self, dev_handle: Handle, intf: int) -> None:
        """Accept the release."""

    def is_kernel_driver_active(self, dev_handle: Handle, intf: int) -> bool:
        """Return False: no kernel driver knows of the simulated device."""
        return False

    def ctrl_transfer(  # pyusb calls it so, by position
        self,
        dev_handle: Handle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array[int],
        timeout: int,
    ) -> int:
        """Bytes read into `data` or written from it; `timeout` in ms, 0 for none. Raises USBError."""
        reading = bool(bmRequestType & 0x80)
        request: dict[str, object] = {
            "op": "control", "index": dev_handle.index, "address": dev_handle.address, "request_type": bmRequestType,
            "request": bRequest, "value": wValue, "offset": wIndex,
        }  # fmt: skip
        request |= {"length": len(data)} if reading else {"data": data.tobytes().hex()}
        reply = self._ask(request, timeout / 1000 if timeout else None)
        if not reading:
            return len(data)
        received = bytes.fromhex(str(reply["data"]))
        data[: len(received)] = array("B", received)
        return len(received)

    def _ask(self, request: Mapping[str, object], timeout_s: float | None) -> dict[str, object]:
        """One line out, one line back. After any failure the connection is dropped, so that a late reply cannot be
        taken for another's; the next request makes a new one."""
        with self._lock:
            try:
                reply = json.loads(self._exchange(json.dumps(request).encode() + b"\n", timeout_s))
            except TimeoutError as error:
                self._drop()
                raise _usb_error(TIMEOUT) from error
            except (OSError, ValueError) as error:
                self._drop()
                raise _usb_error(NO_DEVICE) from error
        if "error" in reply:
            raise _usb_error(reply["error"])
        return reply

    def _exchange(self, line: bytes, timeout_s: float | None) -> bytes:
        if self._connection is None:
            self._connection = socket.create_connection(self._place, timeout_s)
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection.settimeout(timeout_s)
        self._connection.sendall(line)
        received = b""
        while not received.endswith(b"\n"):
            piece = self._connection.recv(65536)
            if not piece:
                raise ConnectionError("the simulator closed the connection")
            received += piece
        return received

    def _finalize_object(self) -> None:
        """pyusb's hook: `finalize()` or the end of the backend closes the connection."""
        self._drop()

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def _usb_error(code: int) -> USBError:
    number, text = ERRORS.get(code, ERRORS[IO_ERROR])
    return (USBTimeoutError if code == TIMEOUT else USBError)(text, code, number)
