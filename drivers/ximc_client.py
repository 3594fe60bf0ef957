"""One XIMC conversation, host side: request and reply in a thread, resynchronised after any error.

A late or damaged reply is never credited to another request: after any error zeros are sent, and since the controller
answers in order, the zero that comes back is behind everything that was still on its way (facts: libximc protocol.xi,
8SMC5-USB manual chapter 6.2).
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.interface import GarbledReply, Refused, Unreachable
from drivers.link import ByteLink
from drivers.ximc import ERROR_SIZES, Damage, Frame, decode, encode

READ_RETRIES = 2
_RESYNC_BURSTS = 4
_RESYNC_ZEROS = bytes(64)
_SETTLE_S = 0.01


class XimcClient:
    """Speaks to one controller over a link made by `connect`; the link is reopened after it broke. Not thread-safe."""

    def __init__(self, device: str, connect: Callable[[], ByteLink], timeout_s: float = 0.25) -> None:
        self._device = device
        self._connect = connect
        self._timeout_s = timeout_s
        self._link: ByteLink | None = None
        self.errors = 0

    def query(self, letters: str, payload_size: int) -> bytes:
        """A read: the reply's payload. Repeated at most READ_RETRIES times after a damaged or missing reply."""
        for attempt in range(READ_RETRIES + 1):
            try:
                return self._exchange(letters, b"", payload_size)
            except (Unreachable, GarbledReply):
                if attempt == READ_RETRIES or self._link is None:
                    raise
        raise Unreachable(self._device, f"no answer to {letters}")

    def command(self, letters: str, payload: bytes = b"") -> None:
        """A write, sent once. After Unreachable or GarbledReply it may have been carried out: read the state."""
        self._exchange(letters, payload, 0)

    def close(self) -> None:
        """Let go of the link; may be called twice."""
        if self._link is not None:
            self._link.close()
        self._link = None

    def _exchange(self, letters: str, payload: bytes, reply_size: int) -> bytes:
        link = self._link = self._link or self._connect()
        try:
            link.write(encode(letters, payload))
            frame = self._receive(link, letters, reply_size)
        except Unreachable:
            self.close()
            raise
        if frame is not None and frame.letters == letters and frame.damage is Damage.NONE:
            return frame.payload
        self.errors += 1
        self._raise_refusal(frame, letters)
        self._resync(link)
        if frame is None:
            raise Unreachable(self._device, f"no answer to {letters} within {self._timeout_s} s")
        raise GarbledReply(self._device, f"the answer to {letters} was {frame.letters!r} ({frame.damage.name})")

    def _receive(self, link: ByteLink, letters: str, reply_size: int) -> Frame | None:
        received = b""
        while data := link.read(self._timeout_s):
            frame, received = decode(received + data, {**ERROR_SIZES, letters: reply_size})
            if frame is not None:
                return frame
        return None

    def _raise_refusal(self, frame: Frame | None, letters: str) -> None:
        if frame is not None and frame.letters == "errc":
            raise Refused(self._device, f"the controller does not know {letters}; is its firmware the right one?")
        if frame is not None and frame.letters == "errv":
            raise Refused(self._device, f"a value in {letters} was out of range and the controller changed it")

    def _resync(self, link: ByteLink) -> None:
        """Zeros until one comes back, then drop what is left; Unreachable when none does."""
        for _ in range(_RESYNC_BURSTS):
            link.write(_RESYNC_ZEROS)
            while data := link.read(self._timeout_s):
                if data.endswith(b"\0"):
                    while link.read(_SETTLE_S):
                        pass
                    return
        self.close()
        raise Unreachable(self._device, "the controller does not answer to resynchronisation")
