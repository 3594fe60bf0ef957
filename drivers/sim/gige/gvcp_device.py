"""The device's end of GVCP: who is in control, what each command does; datagrams in, datagrams out, no socket.

Reads are open to all. Writes belong to the one peer that took the control channel privilege (CCP), and it keeps the
privilege only while it is heard: the heartbeat is real time, as the peer's is.
"""

from __future__ import annotations

from typing import Protocol

from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.camera_registers import DISCOVERY_bytes, Registers
from thermostand.drivers.sim.gige.gvcp import Ack, Command, Nack, Request, Resend, Status

Peer = tuple[str, int]

CCP = 0x0A00
_EXCLUSIVE, _CONTROL = 1, 2


class Device(Protocol):
    """What the commands act on."""

    def before_read(self, address: int, count: int) -> None:
        """Bring the registers of this range up to date; Nack when they cannot be read."""
        ...

    def after_write(self, name: str) -> None:
        """The feature was changed, or the command given."""
        ...

    def resend(self, resend: Resend) -> None:
        """Queue packets once more."""
        ...

    def control_ended(self) -> None:
        """No client is in control any more."""
        ...


_STRANGER: Peer = ("192.0.2.1", 3956)


class ControlChannel:
    """The control protocol of one device; times are s of the host's boot time."""

    def __init__(self, registers: Registers, device: Device) -> None:
        self._registers = registers
        self._device = device
        self._controller: Peer | None = None
        self._heard_s = 0.0
        self._answered: tuple[Peer, bytes] | None = None
        self._answer = b""

    def feed(self, datagram: bytes, peer: Peer, now_s: float) -> bytes:
        """The reply to one datagram, b"" for none. A repeated command is answered again but not executed again."""
        try:
            request = gvcp.decode_request(datagram)
        except gvcp.Malformed:
            return b""
        if peer == self._controller:
            self._heard_s = now_s
        if self._answered == (peer, datagram):
            return self._answer
        ack = self._execute(request, peer, now_s)
        if ack is None or not request.flags & gvcp.ACK_WANTED:
            return b""
        self._answered, self._answer = (peer, datagram), ack.encode()
        return self._answer

    def check_heartbeat(self, now_s: float) -> None:
        """Take the privilege from a controller that has been silent for too long."""
        timeout_s = self._registers.integer("GevHeartbeatTimeout") / 1000
        if self._controller not in (None, _STRANGER) and now_s - self._heard_s > timeout_s:
            self._release()

    def seize(self, on: bool) -> None:
        """Another client takes control and keeps its heartbeat up, or lets go."""
        if self._controller is not None and (on or self._controller == _STRANGER):
            self._release()
        if on:
            self._controller = _STRANGER
            self._registers.put("GevCCP", _CONTROL)

    def forget(self) -> None:
        """The device lost its power: no controller, nothing remembered, no client informed."""
        self._controller = None
        self._answered = None

    def _execute(self, request: Request, peer: Peer, now_s: float) -> Ack | None:
        """The acknowledge; None for a command that has none."""
        try:
            match request.command:
                case Command.DISCOVERY:
                    payload = self._registers.read(0, DISCOVERY_bytes)
                case Command.READREG:
                    addresses = gvcp.unpack_words(request.payload)
                    payload = b"".join(self._read(address, 4) for address in addresses)
                case Command.READMEM:
                    address, count = gvcp.unpack_read_memory(request.payload)
                    payload = gvcp.pack_write_memory(address, self._read(address, count))
                case Command.WRITEREG:
                    payload = self._write_registers(gvcp.unpack_words(request.payload), peer, now_s)
                case Command.WRITEMEM:
                    address, data = gvcp.unpack_write_memory(request.payload)
                    self._write(address, data, peer, now_s)
                    payload = gvcp.pack_written(len(data))
                case Command.PACKETRESEND:
                    self._device.resend(gvcp.unpack_resend(request))
                    return None
                case _:
                    raise Nack(Status.NOT_IMPLEMENTED, f"command {request.command:#06x}")
        except Nack as refused:
            if request.command == Command.PACKETRESEND:
                return None
            return Ack(request.command, request.req_id, status=refused.status)
        return Ack(request.command, request.req_id, payload)

    def _read(self, address: int, count: int) -> bytes:
        if address % 4:
            raise Nack(Status.BAD_ALIGNMENT, f"register {address:#x}")
        self._device.before_read(address, count)
        return self._registers.read(address, count)

    def _write_registers(self, words: tuple[int, ...], peer: Peer, now_s: float) -> bytes:
        if len(words) % 2:
            raise Nack(Status.BAD_PARAMETER, "an address without a value")
        for address, value in zip(words[::2], words[1::2], strict=True):
            self._write(address, value.to_bytes(4, "big"), peer, now_s)
        return gvcp.pack_written(len(words) // 2)

    def _write(self, address: int, data: bytes, peer: Peer, now_s: float) -> None:
        if address == CCP and len(data) == 4:
            self._claim(int.from_bytes(data, "big"), peer, now_s)
            return
        if peer != self._controller:
            raise Nack(Status.ACCESS_DENIED, f"{peer} is not in control")
        for name in self._registers.write(address, data):
            self._device.after_write(name)

    def _claim(self, value: int, peer: Peer, now_s: float) -> None:
        """A write to CCP: take, keep or release the privilege."""
        if self._controller not in (None, peer):
            raise Nack(Status.ACCESS_DENIED, f"{self._controller} is in control")
        privilege = value & (_EXCLUSIVE | _CONTROL)
        if privilege:
            self._controller, self._heard_s = peer, now_s
            self._registers.put("GevCCP", privilege)
        elif self._controller is not None:
            self._release()

    def _release(self) -> None:
        self._controller = None
        self._registers.put("GevCCP", 0)
        self._registers.put("GevSCPHostPort", 0)
        self._device.control_ended()
