"""What happens to a run: told to the hub, folded into its state, noted in its journal."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

from foundation.clock import Clock
from foundation.errors import SessionError
from foundation.hub import Hub
from foundation.items import Event
from recording.writing.disk import Disk
from stand.fault import Fault
from stand.gate import INTERLOCK, STOPPING
from stand.running.entries import Cleared, Ended, Entry, Held, Tripped, Written
from stand.running.fold import after
from stand.running.journal import Journal
from stand.running.state import RunState

_END_WITHIN_S, _COMPLETE_WITHIN_S = 1.0, 10.0  # real seconds that a disk may take for the last entry


class Logbook:
    """`state` is what the entries so far make of a run; from `begin` on those that are to outlive the daemon are in the
    journal, too."""

    def __init__(self, hub: Hub, clock: Clock, state: RunState) -> None:
        self.state = state
        self._hub = hub
        self._clock = clock
        self._journal: Journal | None = None

    async def begin(self, journal: Journal, *entries: Written, disk: Disk | None = None) -> None:
        """The journal's first entries of this run, on the disk when this returns; `disk` writes it."""
        self._journal = journal
        journal.start(self._clock, lambda text: self.tell("error", "journal_not_saved", text), disk)
        await self.write(*entries)

    async def end(self, ended: Ended) -> None:
        """The journal's last entry, at this instant; SessionError when the disk does not take it in time."""
        journal = self._journal
        if journal is None:
            return
        within_s = _COMPLETE_WITHIN_S if ended.status == "complete" else _END_WITHIN_S
        try:
            async with asyncio.timeout(within_s):
                await self.write(Ended(self._clock.now_ns(), ended.status, ended.text))
                await journal.close()
        except TimeoutError as error:
            journal.abandon()
            text = f"the disk has not answered for {within_s:g} s; how the run ended is not in the journal"
            raise SessionError(f"{journal.path}: {text}") from error

    def enter(self, entry: Entry) -> None:
        """Into the state alone: what the recording proves, or the next gap makes void."""
        self.state = after(self.state, entry)

    async def write(self, *entries: Written) -> None:
        """Into the state at once; on the disk when this returns, or kept for the next time."""
        for entry in entries:
            self.enter(entry)
        if self._journal is not None:
            await self._journal.write(*entries)

    def tell(self, level: str, kind: str, text: str, data: Mapping[str, object] | None = None) -> None:
        """An event, now."""
        self._hub.publish(Event(self._clock.now_ns(), level, kind, text, data or {}))

    def tripped(self, fault: Fault) -> None:
        """The guard makes the stand safe; it tells the hub by itself."""
        self._note(Tripped(self._clock.now_ns(), fault.rule, fault.text))

    def held(self, reason: str, held: bool) -> None:
        """A listener of the gate; the end of a run is told by itself."""
        if reason == STOPPING:
            return
        level, kind = ("warning", "held") if held else ("info", "released")
        self.tell(level, kind, reason, {"reason": reason})
        now_ns = self._clock.now_ns()
        if reason == INTERLOCK and not held:
            self._note(Cleared(now_ns))
        self._note(Held(now_ns, reason, held))

    def _note(self, entry: Written) -> None:
        self.enter(entry)
        if self._journal is not None:
            self._journal.note(entry)
