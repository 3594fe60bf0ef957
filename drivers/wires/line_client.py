"""Requests and replies of chambers and instruments on a byte link: text without a transaction number, so a late reply
must not be taken for the next one's. After any error the line rests for longer than a reply takes, and what came is
thrown away.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from thermostand.drivers.wires.link import CLOSING_S, ByteLink, HangUps, SerialSettings, open_link, read_reply
from thermostand.foundation.clock import Now, await_simulated_answers
from thermostand.foundation.errors import GarbledReply, Unreachable

Answer = TypeVar("Answer")

# As the Modbus bus: longer than a late reply may still take. Round number; nothing was measured.
_MARGIN_S = 0.05
_LONGEST_REPLY = 65536  # a device that never ends its reply must not fill the memory
READ_RETRIES = 2  # as every read over a wire (xi- and Modbus); not measured
_FLOW_CONTROL = b"\x11\x13"  # XON and XOFF, which some units send among their replies; 1 and 3 but for one bit


class LineClient:
    """One conversation over a link made by `connect`; blocking, not thread-safe.

    `timeout_s`: real seconds for a whole reply, in virtual time (`clock`) also until the simulated device has nothing
    left to answer; `gap_s`: of silence between a reply and the next request. A broken link
    is closed and opened again by the next request; while `connected` is False nobody knows who will answer. `is_kept`:
    whether a link survives an error (a serial line); a TCP connection is dropped with what may still come, but for the
    first request over it, which some units swallow. is_text: flow control is no part of a reply; since a flipped bit
    makes it of a 1 or a 3, a reply with more or less of it than the one before is asked for once more.
    """

    def __init__(
        self,
        device: str,
        connect: Callable[[], ByteLink],
        timeout_s: float,
        gap_s: float,
        *,
        is_kept: bool,
        is_text: bool = True,
        clock: Now | None = None,
    ) -> None:
        self._device = device
        self._connect = connect
        self._timeout_s = timeout_s
        self._gap_s = gap_s
        self._is_kept = is_kept
        self._is_text = is_text
        self.clock = clock
        self._link: ByteLink | None = None
        self._hang_ups = HangUps()
        self._flow_bytes = 0  # in the last reply
        self._is_first = False  # nothing was asked over this link before
        self._is_swallowed = False  # the first request over it, as far as that can be known
        self._is_asked_again = False  # a read, though its link is gone
        self._free_s = 0.0

    @classmethod
    def at(
        cls,
        device: str,
        address: str,
        line: SerialSettings,
        times_s: tuple[float, float],
        *,
        is_text: bool = True,
        clock: Now | None = None,
    ) -> LineClient:
        """Make the client of the device at `serial:PATH`, with these settings, or `tcp:HOST:PORT`; times_s: time-out
        and gap."""
        is_kept = address.startswith("serial:")
        return cls(
            device, lambda: open_link(device, address, line), *times_s, is_kept=is_kept, is_text=is_text, clock=clock
        )

    @property
    def connected(self) -> bool:
        """The link of the last request still stands, or its peer closes each after one reply."""
        if self._link is not None:
            try:
                _discard(self._link)
            except Unreachable:
                self._close_after_peer()
        return self._link is not None or self._hang_ups.is_known

    def close(self) -> None:
        """Let go of the link; may be called twice."""
        if self._link is not None:
            self._link.close()
        self._link = None

    def query(self, request: bytes, answer: Callable[[bytes], Answer | None]) -> Answer:
        """A read: as `send`, repeated at most READ_RETRIES times over the same link, or over a new one where the peer
        has closed it after one reply."""
        before = b""
        for left in reversed(range(READ_RETRIES + 1)):
            try:
                found, heard = self._exchange(request, answer, is_read=True)
            except (Unreachable, GarbledReply):
                if not left or (self._link is None and not self._is_asked_again):
                    raise
                continue
            if self._is_undamaged(heard, before):
                return found
            before = heard
        raise GarbledReply(self._device, f"flow control changes from reply to reply, the last one was {before[:80]!r}")

    def send(self, request: bytes, answer: Callable[[bytes], Answer | None]) -> Answer:
        """One request, sent once, and what `answer` makes of the bytes that have come: None until they are whole,
        ValueError when they cannot be a reply. Unreachable when nothing comes, GarbledReply when it is none."""
        found, heard = self._exchange(request, answer, is_read=False)
        if not self._flow_bytes and self._flow_count(heard):
            raise GarbledReply(self._device, f"unexpected flow control in {heard[:80]!r}")
        return found

    def _is_undamaged(self, heard: bytes, before: bytes) -> bool:
        """Return whether a reply has as much flow control as the last one; or as the one `before`, to the same request,
        which says as much."""
        count, count_before = self._flow_count(heard), self._flow_count(before)
        is_as_before = count == count_before or min(count, count_before) > 0
        if count != self._flow_bytes and not (is_as_before and _count_characters(heard) == _count_characters(before)):
            return False
        self._flow_bytes = count
        return True

    def _flow_count(self, heard: bytes) -> int:
        """Return how much of it may be a damaged character: what comes behind the end is none."""
        whole = heard.rstrip(_FLOW_CONTROL) if self._is_text else b""
        return sum(whole.count(each) for each in _FLOW_CONTROL)

    def _exchange(
        self, request: bytes, answer: Callable[[bytes], Answer | None], *, is_read: bool
    ) -> tuple[Answer, bytes]:
        """Return what `answer` makes of the reply, and the reply as it came."""
        self._is_swallowed = self._is_asked_again = False
        link = self._clean_link(is_read=is_read)
        is_first, self._is_first = self._is_first, False
        heard = b""
        try:
            link.write(request)
            deadline_s = time.monotonic() + self._timeout_s
            while data := read_reply(link, deadline_s, self.clock):
                heard += data
                text = heard.translate(None, _FLOW_CONTROL) if self._is_text else heard
                if (found := answer(text)) is not None:
                    self._note_answer()
                    return found, heard
                if len(heard) > _LONGEST_REPLY:
                    raise ValueError("it does not end")
        except ValueError as error:
            self._quarantine()
            raise GarbledReply(self._device, f"no valid reply in {heard[:80]!r}: {error}") from error
        except Unreachable:
            self._is_asked_again = not heard and self._close_after_peer()
            self.close()
            raise
        self._is_swallowed = is_first and not heard
        self._quarantine()
        if heard:
            raise GarbledReply(self._device, f"only {heard[:80]!r} came within {self._timeout_s:g} s")
        raise Unreachable(self._device, f"no reply within {self._timeout_s:g} s")

    def tell(self, request: bytes) -> None:
        """One request that is not answered, sent once. Unreachable when the wire is gone."""
        link = self._clean_link(is_read=False)
        self._is_first = False
        try:
            link.write(request)
        except Unreachable:
            self.close()
            raise
        await_simulated_answers(self.clock)  # it is obeyed before time goes on
        self._free_s = time.monotonic() + self._gap_s

    def _clean_link(self, *, is_read: bool) -> ByteLink:
        """The link for the next request, with nothing in it that nobody asked for. What is written into one that its
        peer has closed is never sent: it is opened again, for a write only where that is the peer's way."""
        self._wait()
        if (link := self._link) is not None:
            try:
                if not (is_read or self._is_kept) and self._hang_ups.is_suspect:
                    link.read(CLOSING_S)
                _discard(link)
                return link
            except Unreachable:
                if not (self._close_after_peer() and (is_read or self._hang_ups.is_known)):
                    raise
        link = self._link = self._connect()
        self._hang_ups.opened()
        self._is_first = True
        return link

    def _note_answer(self) -> None:
        self._hang_ups.answered()
        self._free_s = time.monotonic() + self._gap_s
        if self._hang_ups.is_known:
            self.close()  # the peer is about to, and the next request is not to meet that

    def _close_after_peer(self) -> bool:
        """Close what it has closed; whether it did after one reply."""
        self.close()
        return not self._is_kept and self._hang_ups.note_close()

    def _quarantine(self) -> None:
        self._free_s = time.monotonic() + self._timeout_s + _MARGIN_S
        if not (self._is_kept or self._is_swallowed):
            self.close()

    def _wait(self) -> None:
        if (left_s := self._free_s - time.monotonic()) > 0:
            time.sleep(left_s)  # noqa: TID251 - silence on a wire is real seconds


def _discard(link: ByteLink) -> None:
    """Discard what nobody asked for; Unreachable when the peer has closed the link."""
    while link.read(0.0):
        pass


def _count_characters(heard: bytes) -> int:
    """Characters but flow control."""
    return len(heard.translate(None, _FLOW_CONTROL))
