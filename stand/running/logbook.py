"""What happens to a run, told to the hub and noted in its journal."""

from __future__ import annotations

from drivers.clock import Clock
from stand.guarding.interlocks import Fault
from stand.hub import Event, Hub
from stand.running.gate import INTERLOCK, STOPPING
from stand.running.journal import Cleared, Ended, Entry, Held, Journal, Tripped


class Logbook:
    """The hub, and from `begin` on the journal."""

    def __init__(self, hub: Hub, clock: Clock) -> None:
        self._hub = hub
        self._clock = clock
        self._journal: Journal | None = None

    async def begin(self, journal: Journal, *entries: Entry) -> None:
        """The journal's first entries of this run, on the disk when this returns."""
        self._journal = journal
        journal.start(self._clock, lambda text: self.tell("error", "journal_not_saved", text))
        await journal.write(*entries)

    async def end(self, ended: Ended) -> None:
        """The journal's last entry, at this instant."""
        if self._journal is not None:
            await self._journal.write(Ended(self._clock.now_ns(), ended.status, ended.text))
            await self._journal.close()

    def tell(self, level: str, kind: str, text: str) -> None:
        """An event, now."""
        self._hub.publish(Event(self._clock.now_ns(), level, kind, text))

    def tripped(self, fault: Fault) -> None:
        """The guard makes the stand safe; it tells the hub by itself."""
        self._note(Tripped(self._clock.now_ns(), fault.rule, fault.text))

    def held(self, reason: str, held: bool) -> None:
        """A listener of the gate; the end of a run is told by itself."""
        if reason == STOPPING:
            return
        self.tell("warning" if held else "info", "held" if held else "released", reason)
        now_ns = self._clock.now_ns()
        if reason == INTERLOCK and not held:
            self._note(Cleared(now_ns))
        self._note(Held(now_ns, reason, held))

    def _note(self, entry: Entry) -> None:
        if self._journal is not None:
            self._journal.note(entry)
