"""A small session of a run, with its journal: steps that capture a frame each, and an end."""

import json

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.recording.format.journal_lines import JOURNAL_NAME, format_lines, make_mark

from .full_session import PUBLISHED, START_NS, make_half_second, record

SECONDS = 20  # five segments of each series, four frames in each
BEGUN = {"run": "cycle-1", "plan": "0f", "texts": {}, "seed": 7}


def second(time_ns, index):
    """A step a second, which captures a frame."""
    if not index:
        yield Event(time_ns, "info", "run.start", "recipe thermal_cycle", {"steps": SECONDS, "frames": SECONDS})
    yield from make_half_second(time_ns, index)
    if index == SECONDS - 1:
        yield Event(time_ns, "info", "run.end", "complete", {"status": "complete"})


def publish_killed(time_ns, index):
    """The same without an end."""
    yield from (item for item in second(time_ns, index) if getattr(item, "kind", "") != "run.end")


def ended(level, text, **data):
    """`second` with another end."""

    def items(time_ns, index):
        for item in second(time_ns, index):
            is_end = isinstance(item, Event) and item.kind == "run.end"
            yield Event(time_ns, level, "run.end", text, data) if is_end else item

    return items


def publish_half_done(time_ns, index):
    """Of the steps half are done, and the next one is begun, when the operator stops the run."""
    done = SECONDS // 2
    for item in second(time_ns, index):
        if index <= done and not (index == done and isinstance(item, StepMark) and item.state is StepState.DONE):
            yield item
    if index == done:
        yield Event(time_ns, "error", "run.end", "aborted: stopped by the operator", {"status": "stopped"})


def entries(seconds=SECONDS, status="complete"):
    """The journal's entries of such a run; "" is the status of one that was killed."""
    yield {"entry": "Begun", "time_ns": START_NS, **BEGUN}
    for index in range(seconds):
        time_ns = START_NS + index * NS_PER_S
        for state in ("started", "done"):
            yield {"entry": "Step", "time_ns": time_ns, "step_id": f"capture-{index}", "state": state}
    if status:
        yield {"entry": "Ended", "time_ns": START_NS + seconds * NS_PER_S, "status": status, "text": status}


def write_journal(directory, *found):
    """The journal of a session's folder."""
    data = format_lines((json.dumps(entry).encode() for entry in found), make_mark(directory.name))
    (directory / JOURNAL_NAME).write_bytes(data)
    return directory / JOURNAL_NAME


async def record_run(directory, items=second, status="complete", seconds=SECONDS, devices=PUBLISHED):
    """The session in `directory`."""
    await record(directory, seconds, items=items, segment_s=4.0, period_ns=NS_PER_S, devices=devices)
    write_journal(directory, *entries(seconds, status))
    return directory


def remove(directory, series, *numbers):
    """Segments that somebody has deleted."""
    for number in numbers:
        (directory / series / f"{number:04d}.mcap").unlink()
