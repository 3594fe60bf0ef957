"""One XIMC conversation, host side: request and reply in a thread, resynchronised after any error.

A late or damaged reply is never credited to another request: after any error zeros are sent, and since the controller
answers in order, the zeros that come back are behind everything that was still on its way (facts: libximc protocol.xi,
8SMC5-USB manual chapter 6.2). Each request has a zero in front as well, whose echo comes between what was on its way
before and the answer: a frame without it is no answer to this request. A controller that does not echo the zero of the
first request on a link is spoken to without them.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from thermostand.drivers.framing.ximc import ERROR_SIZES, XimcDamage, XimcFrame, decode, encode
from thermostand.drivers.wires.link import ByteLink, read_reply
from thermostand.foundation.clock import Now, await_simulated_answers
from thermostand.foundation.errors import DeviceError, GarbledReply, Refused, Unreachable

READ_RETRIES = 2  # as every read over a wire; not measured
_MARK = b"\0"
_RESYNC_BURSTS = 4  # round number; nothing was measured
_RESYNC_ZEROS = bytes(64)
# So many zeros in a row are an echo: no reply of ours holds more than 29 (GETS at rest, no supply), a break on the line
# is one, and a request cut short swallows at most 14 of a burst. A flipped bit leaves such a run on one of its sides.
_RESYNC_ECHO = bytes(32)
_SETTLE_S = 0.01  # of silence behind an echo: ten bytes at 115200 baud take 1 ms


class XimcClient:
    """Speaks to one controller over a link made by `connect`. Not thread-safe.

    A broken link is closed, and opened again by the next request: while `connected` is False nobody knows who will
    answer. `timeout_s`: real seconds for a whole reply, in virtual time (`clock`) also until the simulated controller
    has nothing left to answer. `errors` counts exchanges that went wrong.
    """

    def __init__(
        self, device: str, connect: Callable[[], ByteLink], timeout_s: float = 0.25, clock: Now | None = None
    ) -> None:
        self._device = device
        self._connect = connect
        self._timeout_s = timeout_s
        self._clock = clock
        self._link: ByteLink | None = None
        self._echoes: bool | None = None  # whether this link's controller echoes a zero; None when not yet known
        self.errors = 0

    @property
    def connected(self) -> bool:
        """The link of the last request still stands."""
        return self._link is not None

    def query(self, letters: str, payload_size: int) -> bytes:
        """A read: the reply's payload. Repeated at most READ_RETRIES times after a damaged or missing reply, never
        over a new link."""
        for _ in range(READ_RETRIES):
            try:
                return self._exchange(letters, b"", payload_size)
            except (Unreachable, GarbledReply):
                if not self.connected:
                    raise
        return self._exchange(letters, b"", payload_size)

    def command(self, letters: str, payload: bytes = b"") -> None:
        """A write, sent once. After Unreachable or GarbledReply it may have been carried out: read the state."""
        self._exchange(letters, payload, 0)

    def close(self) -> None:
        """Let go of the link; may be called twice."""
        if self._link is not None:
            self._link.close()
        self._link = self._echoes = None

    def _exchange(self, letters: str, payload: bytes, reply_size: int) -> bytes:
        """One request and its reply; anything else is an error, and the line is clean again when it is raised."""
        link = self._link = self._link or self._connect()
        try:
            if link.read(0.0).strip(b"\0"):  # unrequested, and more may follow
                self.errors += 1
                self._resync(link)
            # Answers carry no number; a controller echoes zeros one for one and in order, so what comes before the echo
            # is old.
            link.write((b"" if self._echoes is False else _MARK) + encode(letters, payload))
            frame, rest, is_marked = self._receive(link, letters, reply_size)
            if (
                frame is not None
                and (frame.letters, frame.damage) == (letters, XimcDamage.NONE)
                and not rest.strip(b"\0")
            ):
                if self._echoes is None:
                    self._echoes = is_marked
                if is_marked or not self._echoes:
                    return frame.payload
            self.errors += 1
            self._resync(link)
        except Unreachable:
            self.close()
            raise
        raise self._make_error(letters, frame)

    def _receive(self, link: ByteLink, letters: str, reply_size: int) -> tuple[XimcFrame | None, bytes, bool]:
        """The first frame, what came with it, and whether zeros came before it; no frame when none was complete in
        time."""
        deadline_s = time.monotonic() + self._timeout_s
        frame, received, first = None, b"", b""
        while frame is None and (data := read_reply(link, deadline_s, self._clock)):
            first = first or data[:1]
            frame, received = decode(received + data, {**ERROR_SIZES, letters: reply_size})
        return frame, received, first == _MARK

    def _resync(self, link: ByteLink) -> None:
        """Zeros until they come back, then drop what is left; Unreachable when they do not."""
        for _ in range(_RESYNC_BURSTS):
            link.write(_RESYNC_ZEROS)
            deadline_s = time.monotonic() + self._timeout_s
            received = b""
            while data := read_reply(link, deadline_s, self._clock):
                received += data
                if _RESYNC_ECHO in received:
                    await_simulated_answers(self._clock)
                    while time.monotonic() < deadline_s and link.read(_SETTLE_S):
                        pass
                    return
        raise Unreachable(self._device, "the controller does not answer, nor does it echo zeros")

    def _make_error(self, letters: str, frame: XimcFrame | None) -> DeviceError:
        """Return what was wrong with the answer to `letters`."""
        if frame is None:
            return Unreachable(self._device, f"no answer to {letters} within {self._timeout_s:g} s")
        if frame.letters == "errc":
            return Refused(self._device, f"the controller does not know {letters}; is its firmware the right one?")
        if frame.letters == "errv":
            return Refused(self._device, f"a value in {letters} was out of range and the controller changed it")
        if frame.letters == "errd":
            return GarbledReply(self._device, f"the controller received {letters} damaged")
        if frame.damage is XimcDamage.NONE:
            return GarbledReply(self._device, f"more came than the answer to {letters}, or an earlier answer")
        return GarbledReply(self._device, f"the answer to {letters} was {frame.letters!r} ({frame.damage.name})")
