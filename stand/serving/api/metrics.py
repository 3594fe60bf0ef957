"""The stand's numbers in the text format of Prometheus (version 0.0.4), written by hand: twenty lines against a library
whose registry of global counters would be a second memory of the same numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from thermostand.stand.serving.api.bridge import Snapshot
from thermostand.stand.serving.desk import StandState

_PHASES = ("idle", "running", "held", "stopping")
_Sample = tuple[Mapping[str, str], float]


def metrics(snapshot: Snapshot, drops: int, viewers: int) -> str:
    """The whole page."""
    state = snapshot.state
    lines: list[str] = []
    for name, kind, text, samples in (*_of_state(state), *_of_run(state), *_of_interface(snapshot, drops, viewers)):
        lines += [f"# HELP thermostand_{name} {_escaped(text)}", f"# TYPE thermostand_{name} {kind}"]
        lines += [f"thermostand_{name}{_labels(labels)} {value:.17g}" for labels, value in samples]
    return "\n".join(lines) + "\n"


_Metric = tuple[str, str, str, Sequence[_Sample]]


def _of_state(state: StandState) -> Iterator[_Metric]:
    labels = {"stand": state.stand, "version": state.version, "simulated": str(state.simulated).lower()}
    yield "info", "gauge", "The stand and its program.", [(labels, 1.0)]
    yield (
        "phase",
        "gauge",
        "1 for the phase the stand is in.",
        [({"phase": p}, float(p == state.phase)) for p in _PHASES],
    )
    good = {channel: r for channel, r in state.readings.items() if r.value is not None}
    values = [({"channel": channel, "unit": r.unit}, r.value or 0.0) for channel, r in good.items()]
    yield "reading", "gauge", "Last reading of a channel that is not bad, in its unit.", values
    ages = [({"channel": c}, (state.now_ns - r.time_ns) / 1e9) for c, r in state.readings.items()]
    yield "reading_age_seconds", "gauge", "Since a channel was last read.", ages
    bad = [({"channel": c}, float(r.value is None)) for c, r in state.readings.items()]
    yield "reading_bad", "gauge", "1 when the last reading of a channel is no measurement.", bad
    yield "hold", "gauge", "1 for each reason that holds the run.", [({"reason": r}, 1.0) for r in state.reasons]
    fault = [({"rule": state.fault.rule}, 1.0)] if state.fault is not None else []
    yield "fault", "gauge", "1 for the rule that has tripped.", fault
    if state.setpoint_degC is not None:
        yield "setpoint_celsius", "gauge", "Set-point of the chamber.", [({}, state.setpoint_degC)]
    if (hand := state.by_hand) is not None:
        yield "by_hand_setpoint_celsius", "gauge", "Set-point of heat by hand, as ordered.", [({}, hand.setpoint_degC)]
        since = [({}, (state.now_ns - hand.since_ns) / 1e9)]
        yield "by_hand_seconds", "gauge", "Since heat by hand was permitted.", since
    if state.output_percent is not None:
        yield "output_percent", "gauge", "Output of the regulator.", [({}, state.output_percent)]
    yield "heater_permitted", "gauge", "1 while heat is permitted.", [({}, float(state.heater_permitted))]
    yield "compressor_on", "gauge", "1 while the compressor's relay is on.", [({}, float(state.compressor_on))]
    yield "disk_free_bytes", "gauge", "Free for sessions.", [({}, float(state.disk_free_bytes))]
    counters = [({"what": what}, value) for what, value in state.counters.items()]
    yield "wear_total", "counter", "What wears: hours, starts and cycles.", counters
    waiting = sum(run.state in ("waiting", "interrupted") for run in state.queue)
    yield "queue_waiting", "gauge", "Runs still to be done.", [({}, float(waiting))]


def _of_run(state: StandState) -> Iterator[_Metric]:
    run = state.run
    if run is None:
        return
    yield "frames_saved", "gauge", "Frames of this run on the disk.", [({}, float(run.frames_saved))]
    yield "frames_lost", "gauge", "Frames of this run that were lost.", [({}, float(run.frames_lost))]
    yield "step", "gauge", "Number of the step under way.", [({}, float(run.step))]
    yield "steps", "gauge", "Steps of the plan.", [({}, float(run.steps))]
    if run.end_ns is not None:
        yield "left_seconds", "gauge", "Expected until the run ends.", [({}, (run.end_ns - run.now_ns) / 1e9)]


def _of_interface(snapshot: Snapshot, drops: int, viewers: int) -> Iterator[_Metric]:
    yield "snapshot_age_seconds", "gauge", "Since the control loop last said how it is.", [({}, snapshot.age_s)]
    yield "interface_drops_total", "counter", "Items that the interface was too slow for.", [({}, float(drops))]
    yield "viewers", "gauge", "Clients that follow the stream.", [({}, float(viewers))]


def _labels(labels: Mapping[str, str]) -> str:
    return (
        "{" + ",".join(f'{name}="{_escaped(value, quotes=True)}"' for name, value in labels.items()) + "}"
        if labels
        else ""
    )


def _escaped(text: str, *, quotes: bool = False) -> str:
    text = text.replace("\\", "\\\\").replace("\n", "\\n")
    return text.replace('"', '\\"') if quotes else text
