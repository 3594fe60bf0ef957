"""The inspection flap: a Pololu Jrk G2 over its native USB interface (Jrk G2 user's guide, sections 9-14)."""

from __future__ import annotations

import errno
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, cast

import usb.backend
import usb.core
import usb.util

from drivers.clock import Clock, seconds_ns
from drivers.interface import DeviceError, DeviceFault, GarbledReply, Reading, Refused, Unreachable, bad_reading
from drivers.lane import Lane

_VENDOR_POLOLU = 0x1FFB
_PRODUCTS_JRK_G2 = {0x00B7, 0x00B9, 0x00BF, 0x00C1, 0x00C5}
_TO_DEVICE, _TO_HOST = 0x40, 0xC0
_SET_TARGET, _STOP_MOTOR, _GET_VARIABLES, _GET_SETTINGS = 0x84, 0x87, 0xE5, 0xE3
_TIMEOUT_MS = 1600  # the device may need 1,500 ms after restoring its defaults
_VARIABLES_SIZE = 0x35
_INPUT_MODE_OFFSET, _INPUT_MODE_SERIAL = 0x03, 0

_AWAITING_COMMAND = 0x0001
_FEEDBACK_DISCONNECT = 0x0020
_ERROR_NAMES = (
    "awaiting command", "no power", "motor driver error", "input invalid", "input disconnect", "feedback disconnect",
    "soft over-current", "serial signal error", "serial overrun", "serial buffer full", "serial CRC error",
    "serial protocol error", "serial time-out", "hard over-current",
)  # fmt: skip

_POLL_S = 0.05
_CONFIRMATIONS = 3
_FULL_DUTY = 600
_JAM_DUTY = 0.9 * _FULL_DUTY
_JAM_S = 0.5
_JAM_COUNTS = 8


@dataclass(frozen=True, slots=True)
class FlapSettings:
    """`serial_number`: of the USB device. Targets, tolerance: scaled feedback counts, 0..4095. travel_s: longest time
    a whole travel may take on the stand's clock."""

    serial_number: str
    open_target: int
    closed_target: int
    tolerance: int
    travel_s: float


@dataclass(frozen=True, slots=True)
class _Variables:
    target: int
    position: int
    duty: int
    halting: int
    current_mA: int


class _UsbDevice(Protocol):
    """What of a pyusb device is used here; pyusb makes these attributes at run time."""

    idProduct: int
    serial_number: str | None

    def ctrl_transfer(
        self, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data_or_wLength: int | None, timeout: int
    ) -> int | bytes: ...


class Flap:
    """The flap. `backend` is a pyusb backend, None for libusb; the position is unknown until it was read."""

    def __init__(self, name: str, settings: FlapSettings, clock: Clock, backend: usb.backend.IBackend | None) -> None:
        self.name = name
        self._settings = settings
        self._clock = clock
        self._backend = backend
        self._lane = Lane(name, clock)
        self._device: _UsbDevice | None = None

    async def open(self) -> None:
        """Find the controller by its serial number and check its input mode; leaves the flap where it is."""
        await self._lane.call(self._find)

    async def close(self) -> None:
        """Let go of the USB device; the flap stays where it is."""
        await self._lane.call(self._release)
        self._lane.close()

    async def read(self) -> tuple[Reading, ...]:
        """(position 0 closed .. 1 open, motor current mA); BAD position when the feedback is disconnected."""
        variables = await self._lane.call(self._variables)
        now_ns = self._clock.now_ns()
        current = Reading(f"{self.name}.current", float(variables.current_mA), "mA", now_ns)
        if variables.halting & _FEEDBACK_DISCONNECT:
            return bad_reading(f"{self.name}.position", "1", now_ns, "feedback disconnect"), current
        span = self._settings.open_target - self._settings.closed_target
        openness = (variables.position - self._settings.closed_target) / span
        return Reading(f"{self.name}.position", openness, "1", now_ns), current

    async def move_open(self) -> None:
        """Open and confirm; DeviceFault on a jam, an error flag or when the travel takes too long."""
        await self._move(self._settings.open_target)

    async def move_closed(self) -> None:
        """Close and confirm; DeviceFault as in move_open."""
        await self._move(self._settings.closed_target)

    async def make_safe(self) -> None:
        """Closed: the chamber is then a closed box, and the drive's own force limit protects what is in between."""
        await self.move_closed()

    async def _move(self, target: int) -> None:
        await self._lane.call(self._set_target, target)
        deadline_ns = self._clock.now_ns() + seconds_ns(self._settings.travel_s)
        moved_ns, moved_position = self._clock.now_ns(), -(10**6)
        confirmed = 0
        while confirmed < _CONFIRMATIONS:
            await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(_POLL_S))
            variables = await self._lane.call(self._variables)
            now_ns = self._clock.now_ns()
            if variables.halting or variables.target != target:
                raise DeviceFault(self.name, f"the motor stopped: {_names(variables.halting)}")
            if abs(variables.position - moved_position) >= _JAM_COUNTS:
                moved_ns, moved_position = now_ns, variables.position
            if abs(variables.duty) >= _JAM_DUTY and now_ns - moved_ns >= seconds_ns(_JAM_S):
                await self._stop_after(f"jammed at {variables.position} on the way to {target}")
            confirmed = confirmed + 1 if abs(variables.position - target) <= self._settings.tolerance else 0
            if now_ns > deadline_ns and not confirmed:
                await self._stop_after(f"at {variables.position}, not at {target}, after {self._settings.travel_s} s")

    async def _stop_after(self, reason: str) -> None:
        await self._lane.call(self._transfer, _TO_DEVICE, _STOP_MOTOR, 0, 0, 0)
        raise DeviceFault(self.name, f"{reason}; the motor is stopped")

    # Below: in the lane's thread.

    def _find(self) -> None:
        self._release()
        try:
            found = cast(
                "Iterable[_UsbDevice]",
                usb.core.find(find_all=True, backend=self._backend, idVendor=_VENDOR_POLOLU),
            )
            devices = {str(device.serial_number): device for device in found if device.idProduct in _PRODUCTS_JRK_G2}
        except usb.core.NoBackendError as error:
            raise Unreachable(self.name, "libusb is not installed (Debian package libusb-1.0-0)") from error
        except (usb.core.USBError, ValueError, OSError) as error:
            raise Unreachable(self.name, f"USB devices cannot be listed ({error})") from error
        if self._settings.serial_number not in devices:
            present = ", ".join(sorted(devices)) or "none"
            raise Unreachable(self.name, f"no Jrk G2 with serial number {self._settings.serial_number}, only {present}")
        self._device = devices[self._settings.serial_number]
        (mode,) = self._transfer(_TO_HOST, _GET_SETTINGS, 0, _INPUT_MODE_OFFSET, 1)
        if mode != _INPUT_MODE_SERIAL:
            self._release()
            raise Refused(self.name, f"the Jrk's input mode is {mode}, it must be 0 (serial) to obey targets")

    def _release(self) -> None:
        if self._device is not None:
            usb.util.dispose_resources(self._device)
        self._device = None

    def _set_target(self, target: int) -> None:
        """Idempotent, so it may be repeated once after a time-out."""
        try:
            self._transfer(_TO_DEVICE, _SET_TARGET, target, 0, 0)
        except Unreachable:
            self._transfer(_TO_DEVICE, _SET_TARGET, target, 0, 0)

    def _variables(self) -> _Variables:
        block = self._transfer(_TO_HOST, _GET_VARIABLES, 0, 0, _VARIABLES_SIZE)
        target, position, duty, halting = (
            struct.unpack_from(kind, block, offset)[0]
            for kind, offset in (("<H", 0x02), ("<H", 0x06), ("<h", 0x0C), ("<H", 0x12))
        )
        return _Variables(target, position, duty, halting, struct.unpack_from("<H", block, 0x19)[0])

    def _transfer(self, request_type: int, request: int, value: int, index: int, size: int) -> bytes:
        if self._device is None:
            self._find()
        device = cast("_UsbDevice", self._device)
        try:
            answer = device.ctrl_transfer(request_type, request, value, index, size or None, _TIMEOUT_MS)
        except usb.core.USBError as error:
            raise self._error(error, request) from error
        data = b"" if isinstance(answer, int) else bytes(answer)
        if len(data) != size:
            raise GarbledReply(self.name, f"request 0x{request:02X} gave {len(data)} of {size} bytes")
        return data

    def _error(self, error: usb.core.USBError, request: int) -> DeviceError:
        """pyusb's errors by errno, never by text."""
        if error.errno == errno.EPIPE:
            return Refused(self.name, f"the Jrk stalled request 0x{request:02X}")
        if error.errno == errno.EACCES:
            return Refused(self.name, "no permission for the USB device; install Pololu's udev rule")
        if error.errno in (errno.ENODEV, errno.EIO):
            self._release()  # found again by serial number at the next call
        return Unreachable(self.name, f"USB request 0x{request:02X} failed ({error})")


def _names(halting: int) -> str:
    names = [name for bit, name in enumerate(_ERROR_NAMES) if halting >> bit & 1]
    return ", ".join(names) or "its target was changed by someone else"
