"""Limits of one's own for what any device of the stand measures (`guard.channels`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import CONNECTED, guard_rule
from thermostand.stand.config.guard_section import ChannelLimits
from thermostand.stand.safety.fault import DONE, Fault, Readings, Rule, Watch

CHANNEL_LIMIT = guard_rule(
    "channel_limit",
    "a channel is outside the limits that `guard.channels` sets for it",
    "see to what it measures; its limits are in the stand's file below `guard.channels`",
)
CHANNEL_SILENT = guard_rule("channel_silent", "a channel with limits in `guard.channels` has no reading", CONNECTED)


def limit_watches(limited: Mapping[str, ChannelLimits]) -> Iterator[Watch]:
    """What is looked at for the limits of these channels. Without a reading nobody knows whether a limit is kept: that
    waits for an operator, but it does not end a run."""
    for channel, limits in limited.items():
        yield Watch(_outside(channel, limits), limits.after_s, DONE[limits.action])
        yield Watch(
            _silent(channel, limits.after_s),
            action="warn" if limits.action == "warn" else "hold",
            after_gap_s=limits.after_s,
        )


def _outside(channel: str, limits: ChannelLimits) -> Rule:
    """The last value of `channel` is outside its limits. One that has no value is the matter of `_silent`."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.known(channel)
        if reading is None:
            return None
        unit = "" if reading.unit in ("", "1") else f" {reading.unit}"
        shown = f"{channel} is {reading.value:.6g}{unit}"
        if limits.lowest is not None and reading.value < limits.lowest:
            return Fault(CHANNEL_LIMIT, f"{shown}, below its limit of {limits.lowest:g}{unit}")
        if limits.highest is not None and reading.value > limits.highest:
            return Fault(CHANNEL_LIMIT, f"{shown}, above its limit of {limits.highest:g}{unit}")
        return None

    return rule


def _silent(channel: str, after_s: float) -> Rule:
    """`channel` has had no measurement for longer than `after_s`, since the guard began to look at the earliest."""
    begun_ns: int | None = None

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        nonlocal begun_ns
        begun_ns = now_ns if begun_ns is None else begun_ns
        good_ns, latest = readings.last_good_ns(channel), readings.latest(channel)
        silent_ns = now_ns - max(begun_ns, good_ns or 0)
        if silent_ns <= to_ns(after_s):
            return None
        why = "it has never been read" if latest is None else latest.reason or "it is not read any more"
        return Fault(CHANNEL_SILENT, f"{channel} has no reading for {silent_ns / NS_PER_S:.0f} s: {why}")

    return rule
