"""Requests and replies of chambers on a byte link: text without a transaction number, so a late reply must not be
taken for the next one's. After any error the line rests for longer than a reply takes, and what came is thrown away.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from drivers.wires.link import ByteLink, SerialSettings, open_link
from foundation.errors import GarbledReply, Unreachable

Answer = TypeVar("Answer")

_MARGIN_S = 0.05
_LONGEST_REPLY = 65536
READ_RETRIES = 2


class LineClient:
    """One conversation over a link made by `connect`; blocking, not thread-safe.

    `timeout_s`: real seconds for a whole reply; `gap_s`: of silence between a reply and the next request. A broken link
    is closed and opened again by the next request; while `connected` is False nobody knows who will answer. `is_kept`:
    whether a link survives an error (a serial line); a TCP connection is dropped with what may still come.
    """

    def __init__(
        self, device: str, connect: Callable[[], ByteLink], timeout_s: float, gap_s: float, *, is_kept: bool
    ) -> None:
        self._device = device
        self._connect = connect
        self._timeout_s = timeout_s
        self._gap_s = gap_s
        self._is_kept = is_kept
        self._link: ByteLink | None = None
        self._free_s = 0.0

    @classmethod
    def at(cls, device: str, address: str, line: SerialSettings, timeout_s: float, gap_s: float) -> LineClient:
        """Of the device at `serial:PATH`, with these settings, or `tcp:HOST:PORT`."""
        is_kept = address.startswith("serial:")
        return cls(device, lambda: open_link(device, address, line), timeout_s, gap_s, is_kept=is_kept)

    @property
    def connected(self) -> bool:
        """The link of the last request still stands."""
        return self._link is not None

    def close(self) -> None:
        """Let go of the link; may be called twice."""
        if self._link is not None:
            self._link.close()
        self._link = None

    def query(self, request: bytes, answer: Callable[[bytes], Answer | None]) -> Answer:
        """A read: as `send`, repeated at most READ_RETRIES times over the same link."""
        for _ in range(READ_RETRIES):
            try:
                return self.send(request, answer)
            except (Unreachable, GarbledReply):
                if not self.connected:
                    raise
        return self.send(request, answer)

    def send(self, request: bytes, answer: Callable[[bytes], Answer | None]) -> Answer:
        """One request, sent once, and what `answer` makes of the bytes that have come: None until they are whole,
        ValueError when they cannot be a reply. Unreachable when nothing comes, GarbledReply when it is none."""
        self._wait()
        link = self._link = self._link or self._connect()
        heard = b""
        try:
            while link.read(0.0):
                pass  # nobody asked for it
            link.write(request)
            deadline_s = time.monotonic() + self._timeout_s
            while (left_s := deadline_s - time.monotonic()) > 0 and (data := link.read(left_s)):
                heard += data
                if (found := answer(heard)) is not None:
                    self._free_s = time.monotonic() + self._gap_s
                    return found
                if len(heard) > _LONGEST_REPLY:
                    raise ValueError("it does not end")
        except ValueError as error:
            self._quarantine()
            raise GarbledReply(self._device, f"no valid reply in {heard[:80]!r}: {error}") from error
        except Unreachable:
            self.close()
            raise
        self._quarantine()
        if heard:
            raise GarbledReply(self._device, f"only {heard[:80]!r} came within {self._timeout_s:g} s")
        raise Unreachable(self._device, f"no reply within {self._timeout_s:g} s")

    def tell(self, request: bytes) -> None:
        """One request that is not answered, sent once. Unreachable when the wire is gone."""
        self._wait()
        link = self._link = self._link or self._connect()
        try:
            while link.read(0.0):
                pass  # nobody asked for it
            link.write(request)
        except Unreachable:
            self.close()
            raise
        self._free_s = time.monotonic() + self._gap_s

    def _quarantine(self) -> None:
        self._free_s = time.monotonic() + self._timeout_s + _MARGIN_S
        if not self._is_kept:
            self.close()

    def _wait(self) -> None:
        if (left_s := self._free_s - time.monotonic()) > 0:
            time.sleep(left_s)  # noqa: TID251 - silence on a wire is real seconds
