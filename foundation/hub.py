"""Where every reading, frame, event and step mark passes once: publish, latest, subscribe."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.readings import Quality, Reading
from thermostand.foundation.repeat_limit import RepeatLimit

Subscriber = Callable[[Item], None]


class Hub:
    """Keeps the latest reading of each channel and hands each item to every subscriber, in order of subscription.

    Subscribers must return at once (enqueue, count, compare); one that does slow work has a queue of its own. limit: of
    messages that repeat.
    """

    def __init__(self, limit: RepeatLimit | None = None) -> None:
        self._limit = limit
        self._latest: dict[str, Reading] = {}
        self._known: dict[str, Reading] = {}
        self._good_ns: dict[str, int] = {}
        self._subscribers: list[Subscriber] = []

    def subscribe(self, subscriber: Subscriber) -> None:
        """Call `subscriber(item)` for every item published from now on."""
        self._subscribers.append(subscriber)

    def unsubscribe(self, subscriber: Subscriber) -> None:
        """Call it no more; nothing happens when it was not subscribed."""
        self._subscribers = [each for each in self._subscribers if each != subscriber]

    def publish(self, item: Item) -> None:
        """Remember the readings of a batch, then hand the item on."""
        if isinstance(item, Batch):
            for event in self._limit.pop_due(item.time_ns) if self._limit is not None else ():
                self._hand_on(event)
            for reading in item.readings:
                self._latest[reading.channel] = reading
                if reading.cause != "wire":
                    self._known[reading.channel] = reading
                if reading.quality is Quality.GOOD or reading.cause == "suspect":
                    self._good_ns[reading.channel] = reading.time_ns
        if self._limit is not None and isinstance(item, Event):
            admitted = self._limit.admit(item)
            if admitted is None:
                return
            item = admitted
        self._hand_on(item)

    def _hand_on(self, item: Item) -> None:
        for subscriber in self._subscribers:
            subscriber(item)

    def latest(self, channel: str) -> Reading | None:
        """The last reading of `channel`, or None when there was none yet."""
        return self._latest.get(channel)

    @property
    def readings(self) -> Mapping[str, Reading]:
        """The last reading of every channel there was one of; it changes as readings come."""
        return self._latest

    def known(self, channel: str) -> Reading | None:
        """The last reading but for those that are BAD by the wire, which say nothing of what is measured: a single lost
        reply does not erase it. How old it may be is for the guard (trustworthy) to judge."""
        return self._known.get(channel)

    def last_good_ns(self, channel: str) -> int | None:
        """Return when `channel` was last measured, GOOD or with a suspect value, or None when it never was."""
        return self._good_ns.get(channel)
