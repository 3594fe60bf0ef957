"""Alerts of a stand to people elsewhere, and the sign of life to a service that raises the alarm when it stays away.

Receivers are addresses of Apprise, and a command of the configuration. The hub's subscriber only puts events into a
queue. For each kind of receiver a thread judges them and asks a process of its own to send; another one gives the sign
of life. A receiver that hangs delays later messages to its kind, and nothing else.
"""

from __future__ import annotations

import asyncio
import importlib.util
import queue
import shutil
from collections import deque
from collections.abc import AsyncGenerator, Callable, Collection, Iterable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from typing import NamedTuple

from thermostand.foundation.clock import NS_PER_S, Clock, VirtualClock, boot_time_ns, to_ns
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import ALERT_FAILED, RUN_BEGINS, RUN_END, RUN_FAILED, TITLES, AlertCause, make_alert
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.foundation.tasks import cancel_all, describe_failure, find_cause
from thermostand.foundation.worker_process import WorkerProcess
from thermostand.stand.config.alerts_section import AlertsConfig, load_secrets
from thermostand.stand.serving.alerts_process import MISSING, MODULE, Failures, deliver, ping, run_command

# Which events of a stand become messages: each cause once, when it has lasted, and once more when it is over.

_HOUR_NS = to_ns(3600)
_BAD: frozenset[AlertCause] = frozenset({"trip", "hold", "device_lost", "disk"})


class AlertMessage(NamedTuple):
    """What is sent."""

    cause: AlertCause
    title: str
    text: str


@dataclass
class AlertTracker:
    """The tracker of messages that are due. Of one cause and key there is one message until it is over; a run's begin
    or end, and what has no end, are sent each time. With more than most_per_h in an hour only trips are sent, and how
    many were left out."""

    name: str
    causes: Collection[AlertCause]
    grace_ns: int
    most_per_h: int
    _open: dict[tuple[AlertCause, str], tuple[Event, bool]] = field(
        default_factory=dict[tuple[AlertCause, str], tuple[Event, bool]]
    )  # the event, and whether it was sent
    _sent_ns: deque[int] = field(default_factory=deque[int])
    _left_out: int = 0
    _run_ended: bool = False

    @property
    def is_well(self) -> bool:
        """Whether nothing is wrong; may be asked from another thread."""
        return not any(cause in _BAD and key != "nearly full" for cause, key in tuple(self._open))

    def receive(self, event: Event, now_ns: int) -> list[AlertMessage]:
        """Return what is to be sent at once."""
        alert = make_alert(event)
        if alert is None:
            return []
        if alert.phase == "over":
            before = self._open.pop((alert.cause, alert.key), None)
            text = f"{event.text} (it was: {before[0].text})" if before else ""
            return self._limit([(alert.cause, "ok again", text)] if before and before[1] else [], now_ns)
        if event.kind in (*RUN_BEGINS, RUN_END):
            self._open = {}
            self._run_ended = event.kind == RUN_END
        elif event.kind == RUN_FAILED and self._run_ended and "run" not in event.data:
            return []  # its end was an alert; a run of a queue that has not begun is another one
        if alert.cause not in _BAD:
            return self._limit([(alert.cause, TITLES[alert.cause], event.text)], now_ns)
        known = self._open.get((alert.cause, alert.key))
        if known is not None and (known[1] or alert.phase == "lasting"):
            return []
        is_due = alert.phase == "raised"
        self._open[alert.cause, alert.key] = (event, is_due)
        return self._limit([(alert.cause, TITLES[alert.cause], event.text)] if is_due else [], now_ns)

    def due(self, now_ns: int) -> list[AlertMessage]:
        """Return what has lasted for the grace time by now."""
        found: list[tuple[AlertCause, str, str]] = []
        for (cause, key), (event, was_sent) in self._open.items():
            if not was_sent and now_ns - event.time_ns >= self.grace_ns:
                self._open[cause, key] = (event, True)
                found.append((cause, TITLES[cause], event.text))
        return self._limit(found, now_ns)

    def _limit(self, found: Iterable[tuple[AlertCause, str, str]], now_ns: int) -> list[AlertMessage]:
        """Select the alerts that are wanted, within what an hour may have."""
        messages: list[AlertMessage] = []
        while self._sent_ns and now_ns - self._sent_ns[0] >= _HOUR_NS:
            self._sent_ns.popleft()
        for cause, title, text in found:
            if cause not in self.causes:
                continue
            if len(self._sent_ns) >= self.most_per_h and cause != "trip":
                self._left_out += 1
                continue
            more = f"\n{self._left_out} messages before this one were left out" if self._left_out else ""
            self._left_out = 0
            self._sent_ns.append(now_ns)
            messages.append(AlertMessage(cause, f"{self.name}: {title}", f"{text}{more}"))
        return messages


_LIMIT_S = 20.0  # for an address
_LOOK_S = 0.5  # how late a message may begin; not measured
_BEAT_S = 1.0  # 15 of them may fail to come before it is late
_LATE_NS = to_ns(15.0)  # an event loop that has not come round for so long is not well
_AGAIN_S = (15.0, 60.0, 300.0, 1200.0)  # after a try that failed: networks come back
_MOST_WAITING = 100  # round number; nothing was measured
_FAREWELL_S = 5.0  # real seconds for the last messages


def missing_command(config: AlertsConfig) -> str:
    """Return why alerts.command cannot be run, "" when it can, or there is none."""
    if not config.command or shutil.which(config.command[0]) is not None:
        return ""
    return (
        f"alerts.command: {config.command[0]} is no program that can be run here, nobody would be alerted by it; "
        "install it, give its whole path, or take the line out"
    )


def check_alerts(config: AlertsConfig) -> None:
    """ConfigError when alerts are asked for that could not be sent."""
    if missing := missing_command(config):
        raise ConfigError(missing)
    if config.secrets is None:
        return
    load_secrets(config.secrets)
    if importlib.util.find_spec("apprise") is None:
        raise ConfigError(f"alerts.secrets: {MISSING}, or take the line out")


@asynccontextmanager
async def send_alerts(
    name: str, config: AlertsConfig, hub: Hub, clock: Clock, is_well: Callable[[], bool] = lambda: True
) -> AsyncGenerator[None]:
    """Alerts of the stand `name` while inside, none in virtual time or without a receiver. is_well: whether the sign of
    life may be given, asked each second on the loop; what this knows of by itself (a hold, a lost device, a loop that
    stands still) counts besides. ConfigError as check_alerts."""
    # A run in virtual time alarms nobody.
    if isinstance(clock, VirtualClock) or (config.secrets is None and not config.command):
        yield
        return
    await asyncio.to_thread(check_alerts, config)
    alerts = Alerts(name, config, asyncio.get_running_loop(), hub, clock)
    hub.subscribe(alerts)
    beating = asyncio.create_task(alerts.beat(is_well))
    try:
        yield
    except Exception as raised:
        alerts(RUN_FAILED.at(clock.now_ns(), describe_failure(find_cause(raised))))
        raise
    finally:
        hub.unsubscribe(alerts)
        await cancel_all([beating])
        await asyncio.to_thread(alerts.close)


class Alerts:
    """A subscriber of the hub. The addresses, the command and the sign of life have a thread and a process each, so
    that none of them waits for another."""

    def __init__(
        self, name: str, config: AlertsConfig, loop: asyncio.AbstractEventLoop, hub: Hub, clock: Clock
    ) -> None:
        self._every_s = config.alive_every_s
        self._loop, self._hub, self._clock = loop, hub, clock
        self._ending = Flag()
        self._beat_ns = 0
        grace_ns = to_ns(config.grace_s)
        self._senders: list[_Sender] = []
        self._deliveries: list[_Delivery] = []
        if config.command:
            book = AlertTracker(name, config.command_causes, grace_ns, config.most_per_h)
            send = partial(run_command, config.command, config.command_limit_s)
            self._deliveries.append(_Delivery(book, send, self._sender("command"), clock))
        works: list[Callable[[], None]] = []
        if config.secrets is not None:
            book = AlertTracker(name, config.causes, grace_ns, config.most_per_h)
            send = partial(deliver, config.secrets, _LIMIT_S)
            self._deliveries.append(_Delivery(book, send, self._sender("addresses"), clock))
            works.append(partial(self._ping_on, config.secrets, self._sender("alive")))
        works += [partial(each.work, self._ending) for each in self._deliveries]
        self._threads = [Thread(target=work, name="alerts", daemon=True) for work in works]
        for thread in self._threads:
            thread.start()

    def __call__(self, item: Item) -> None:
        """Take note of an event; returns at once."""
        if isinstance(item, Event) and make_alert(item) is not None:
            for delivery in self._deliveries:
                delivery.events.put(item)

    async def beat(self, is_well: Callable[[], bool]) -> None:
        """The loop comes round, until cancelled."""
        while True:
            self._beat_ns = boot_time_ns() if is_well() else 0
            await asyncio.sleep(_BEAT_S)

    def close(self) -> None:
        """Send what is due, as far as that goes in a few seconds; blocking. A command under way runs to its end."""
        self._ending.set()
        until_ns = boot_time_ns() + to_ns(_FAREWELL_S)
        for thread in self._threads:
            thread.join(max(0.0, (until_ns - boot_time_ns()) / NS_PER_S))
        for sender in self._senders:
            sender.close()

    def _sender(self, line: str) -> _Sender:
        self._senders.append(_Sender(line, self._warn))
        return self._senders[-1]

    def _ping_on(self, secrets: Path, sender: _Sender) -> None:
        """The thread that gives the sign of life."""
        due_ns = 0
        while not self._ending.wait(_LOOK_S):
            now_ns = boot_time_ns()
            is_well = all(delivery.book.is_well for delivery in self._deliveries)
            if now_ns >= due_ns and now_ns - self._beat_ns < _LATE_NS and is_well:
                due_ns = now_ns + to_ns(self._every_s)
                sender.ask(partial(ping, secrets, _LIMIT_S))

    def _warn(self, failure: str) -> None:
        """An event on the loop."""
        event = ALERT_FAILED.at(self._clock.now_ns(), failure)
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._hub.publish, event)


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A message to be sent, not before at_ns (of the time since boot). tried: how often it was; only: the numbers of
    those that have not taken it, () for all."""

    message: AlertMessage
    at_ns: int = 0
    tried: int = 0
    only: tuple[int, ...] = ()


@dataclass
class _Sender:
    """A process that sends. It is there before it is needed, and started again when it has ended: a daemon that has no
    descriptor left, or waits for a disk, need not start a program itself. warn: gets each failure once until a call has
    succeeded."""

    line: str
    warn: Callable[[str], None]
    _helper: WorkerProcess | None = None
    _failed: set[str] = field(default_factory=set[str])

    def start(self) -> WorkerProcess:
        """Raises OSError when it cannot be started."""
        if self._helper is None or self._helper.ended:
            self._helper = WorkerProcess(MODULE, (self.line,), "the process that sends alerts has ended")
        return self._helper

    def ask(self, call: partial[Failures]) -> Failures:
        """The call's result, by the process; number 0 when that has failed."""
        try:
            failures = self.start().line(self.line).run(call.func, *call.args)
        except OSError as error:
            failures = [(0, str(error))]
        if not failures:
            self._failed.clear()
        for _, failure in failures:
            if failure not in self._failed:
                self._failed.add(failure)
                self.warn(failure)
        return failures

    def close(self) -> None:
        if self._helper is not None:
            self._helper.close()


class _Delivery:
    """Judges events, and sends the messages that are due to receivers of one kind: its `work` is a thread."""

    def __init__(self, book: AlertTracker, send: partial[Failures], sender: _Sender, clock: Clock) -> None:
        self.book = book
        self.events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._send, self._sender, self._clock = send, sender, clock
        self._waiting: deque[_Waiting] = deque()

    def work(self, ending: Flag) -> None:
        """Send until `ending`. At the end everything is tried once more at once."""
        with suppress(OSError):
            self._sender.start()
        while True:
            is_last = ending.wait(_LOOK_S)
            now_ns = self._clock.now_ns()
            found = list(self.book.due(now_ns))
            with suppress(queue.Empty):
                while True:
                    found += self.book.receive(self.events.get_nowait(), now_ns)
            self._waiting.extend(_Waiting(message) for message in found)
            while len(self._waiting) > _MOST_WAITING:
                self._waiting.popleft()
            for _ in range(len(self._waiting)):
                self._try(self._waiting.popleft(), is_last=is_last)
            if is_last:
                return

    def _try(self, due: _Waiting, *, is_last: bool) -> None:
        """Try to deliver; a receiver that has taken a message does not get it again because another one has not."""
        if boot_time_ns() < due.at_ns and not is_last:
            self._waiting.append(due)
            return
        failures = self._sender.ask(partial(self._send, due.message.title, due.message.text, due.only))
        if failures and due.tried < len(_AGAIN_S):
            at_ns, of = boot_time_ns() + to_ns(_AGAIN_S[due.tried]), tuple(number for number, _ in failures)
            self._waiting.append(_Waiting(due.message, at_ns, due.tried + 1, due.only if 0 in of else of))
