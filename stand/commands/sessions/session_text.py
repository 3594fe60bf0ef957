"""Recorded sessions for people (lines of at most 100 columns) and for programs (JSON)."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace

from thermostand.foundation.instants import format_duration, format_local
from thermostand.foundation.items import Event, StepState
from thermostand.foundation.usage import escape_line
from thermostand.recording.format.inventory import SegmentState
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.catalogue import ListedSession, make_entry
from thermostand.recording.reading.overview import ChannelRange, FramesSummary, Overview, RunStep
from thermostand.recording.reading.run_status import Files
from thermostand.recording.reading.scan import Scan, summarise_findings
from thermostand.stand.commands.sessions.session_table import format_size, make_entry_json

WIDTH = 100
_LABEL = 14
_MOST = 20  # entries of a list before the rest is only counted


def format_info(found: Overview) -> Iterator[str]:
    """`stand session info`."""
    utc = found.scanned.utc
    parts = (
        _format_facts(found, utc),
        _format_steps(found, utc),
        _format_frames(found, utc),
        _channels(found.channels),
        (*_format_gaps(found, utc), *_format_events(found.events, utc)),
    )
    for position, part in enumerate(parts):
        if position:
            yield ""
        yield from part


def _make_entry(found: Overview) -> ListedSession:
    """Make the entry as the list has it, with the steps of the system clock in between."""
    seen, utc = found.scanned, found.scanned.utc
    start_ns = None if seen.begin_ns is None else utc.utc_ns(seen.begin_ns)
    end_ns = None if seen.end_ns is None else utc.utc_ns(seen.end_ns)
    return replace(make_entry(seen), start_ns=start_ns, end_utc_ns=end_ns)


def _format_instant(time_ns: int | None, utc: UtcOffsets) -> str | None:
    return None if time_ns is None else utc.utc_text(time_ns)


def _format_row(label: str, text: str) -> Iterator[str]:
    """Yield the lines of a label with its text to the right, wrapped; a path stays whole, to be copied."""
    wrapper = textwrap.TextWrapper(
        WIDTH, f"{label:<{_LABEL}}", " " * _LABEL, break_long_words=False, break_on_hyphens=False
    )
    yield from wrapper.wrap(escape_line(text))


def _format_facts(found: Overview, utc: UtcOffsets) -> Iterator[str]:
    seen = found.scanned
    stated = seen.metadata.get
    name, known_as = seen.path.resolve().name, stated("session_id", "")
    alias = f", recorded as {known_as}" if known_as not in ("", name) else ""
    yield from _format_row("session", f"{name}{alias}")
    yield from _format_row("run", str(seen.run))
    yield from _format_row("files", str(found.scanned.files))
    yield from _format_row("recipe", stated("recipe", "?") + (", simulated devices" if seen.simulated else ""))
    if seen.begin_ns is not None and seen.end_ns is not None:
        span = f"{utc.date_time(seen.begin_ns)} to {utc.local_text(seen.end_ns)}"
        yield from _format_row(
            "recorded", f"{span}, {format_duration(seen.end_ns - seen.begin_ns)}, {stated('clock_source', '?')} clock"
        )
    ending = "not recorded" if found.ending is None else found.ending.text
    yield from _format_row("ended", ending)
    yield from _format_row("operator", stated("operator", "") or "not named")
    yield from _format_row("camera", stated("camera_serial", "?") + (f"; {seen.lacks}" if seen.lacks else ""))
    host = f", host {stated('host')}" if stated("host") else ""
    yield from _format_row("software", f"thermostand {stated('software_version', '?')}{host}")
    yield from _format_row("segments", _format_segments(seen))
    yield from _format_row("attached", ", ".join(seen.attachments) or "nothing")
    yield from _format_notes(make_entry(seen))
    for trouble in _limit(found.scanned.sentences(Files.DAMAGED)):
        yield from _format_row("damaged", trouble)
    for text in _limit(seen.sentences(Files.INCOMPLETE)):
        yield from _format_row("missing", text)
    if found.scanned.sentences(Files.DAMAGED) or seen.count(SegmentState.UNFINISHED):
        yield from _format_row("to do", f"stand session repair {seen.path}")


def _format_notes(entry: ListedSession) -> Iterator[str]:
    """Yield the tags and notes of the session, and where its copies are."""
    if entry.tags:
        yield from _format_row("tags", ", ".join(entry.tags))
    for text in _limit([f"{format_local(note.time_ns)} {note.by}: {note.text}" for note in entry.notes]):
        yield from _format_row("note", text)
    yield from _format_row("archived", entry.archived or ("not as it is now" if entry.copies else "not yet"))


def _format_segments(seen: Scan) -> str:
    by_series: dict[str, list[int]] = {}
    for file in seen.inventory:
        if file.state is SegmentState.FINISHED:
            by_series.setdefault(file.series, []).append(file.size_bytes)
    parts = [f"{series} {len(sizes)} ({format_size(sum(sizes))})" for series, sizes in by_series.items()]
    others = [
        f"{file.name} is {file.state} ({format_size(file.size_bytes)})"
        for file in seen.inventory
        if file.state is not SegmentState.FINISHED
    ]
    return "; ".join([", ".join(parts) or "none finished", *_limit(others)])


def _limit(entries: Sequence[str]) -> list[str]:
    """The first entries and how many more there are."""
    more = len(entries) - _MOST
    return [*entries[:_MOST], *([f"and {more} more"] if more > 0 else [])]


def _format_steps(found: Overview, utc: UtcOffsets) -> Iterator[str]:
    """Finished steps are counted against the plan, not against those that were begun."""
    steps = found.steps
    kinds = Counter(step.kind for step in steps if step.state is StepState.DONE)
    listed = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    planned = "" if found.planned_steps is None else f" of {found.planned_steps}"
    yield from _format_row(
        "steps", f"{kinds.total()}{planned} done{f': {listed}' if listed else ''}" if steps else "none"
    )
    stated = {
        StepState.FAILED: "failed",
        StepState.SKIPPED: "was left out",
        StepState.STARTED: "has no end in the recording",
    }
    for step in steps:
        if step.state is not StepState.DONE:
            parameters = " ".join(f"{name}={value}" for name, value in step.parameters.items())
            begun = f"begun {utc.local_text(step.begin_ns)}"
            text = f"{step.index} {step.kind} {parameters} {stated[step.state]}, {begun}"
            yield from _format_row("  not done", text)


def _format_frames(found: Overview, utc: UtcOffsets) -> Iterator[str]:
    frames = found.frames
    if not frames.count:
        yield from _format_row("frames", f"none{_format_losses(frames)}")
        return
    each = format_size(round(frames.size_bytes / frames.count))
    yield from _format_row("frames", f"{frames.count}, {frames.pixels}, {each} each{_format_losses(frames)}")
    if frames.first_ns is not None and frames.last_ns is not None:
        yield from _format_row("", f"from {utc.date_time(frames.first_ns)} to {utc.local_text(frames.last_ns)}")
    captures = [step for step in found.steps if step.frames]
    yield from _limit([_format_capture(step, utc) for step in captures])


def _format_losses(frames: FramesSummary) -> str:
    parts: list[str] = []
    if frames.dropped:
        parts.append(f"{frames.dropped} lost by the camera or its wire")
    if frames.lost_by_recorder:
        parts.append(f"{frames.lost_by_recorder} lost by the recorder")
    parts += [f"{count} flagged {flag}" for flag, count in sorted(frames.flagged.items())]
    return "".join(f"; {part}" for part in parts)


def _format_capture(step: RunStep, utc: UtcOffsets) -> str:
    stated = " ".join(f"{name}={step.parameters[name]}" for name in ("role", "chamber_degC") if name in step.parameters)
    asked = step.parameters.get("frames", "?")
    begun = utc.date_time(step.begin_ns)
    return f"{'':<{_LABEL}}step {step.index + 1:<4d} {step.frames} of {asked} frames from {begun}  {stated}"


def _channels(channels: Sequence[ChannelRange]) -> Iterator[str]:
    if not channels:
        yield from _format_row("readings", "none")
        return
    names = [escape_line(f"{row.channel} {row.unit}" if row.unit not in ("", "1") else row.channel) for row in channels]
    width = max(map(len, names))
    yield f"{'readings':<{_LABEL}}{'':<{width}}{'min':>9}{'mean':>9}{'max':>9}{'readings':>10}{'BAD':>8}"
    for name, row in zip(names, channels, strict=True):
        ends = (row.min, row.mean, row.max)
        numbers = "".join(f"{'-':>9}" if math.isnan(value) else f"{value:>9.5g}" for value in ends)
        yield f"{'':<{_LABEL}}{name:<{width}}{numbers}{row.count:>10}{row.bad:>8}"


def _format_gaps(found: Overview, utc: UtcOffsets) -> Iterator[str]:
    for position, gap in enumerate(_limit([gap.text(utc) for gap in found.gaps]) or ["none"]):
        yield from _format_row("" if position else "gaps", gap)


def _format_events(events: Sequence[Event], utc: UtcOffsets) -> Iterator[str]:
    counts = Counter(event.level for event in events)
    yield from _format_row("events", ", ".join(f"{count} {level}" for level, count in sorted(counts.items())) or "none")
    grave = [event for event in events if event.level != "info"]
    for line in _limit([f"{utc.date_time(event.time_ns)} {event.level}: {event.text}" for event in grave]):
        yield from _format_row("", line)


def make_info_json(found: Overview) -> dict[str, object]:
    """`stand session info --json`: everything, lists in full; null for min, mean and max of a channel that was never
    good. Instants are as in make_entry_json."""
    utc = found.scanned.utc
    return {
        **make_entry_json(_make_entry(found)),
        "files": str(found.scanned.files),
        "troubles": list(found.scanned.sentences(Files.DAMAGED)),
        "planned_steps": found.planned_steps,
        "attachments": list(found.scanned.attachments),
        "ending": None if found.ending is None else found.ending.text,
        "steps": [
            {**asdict(step), "begin": _format_instant(step.begin_ns, utc), "end": _format_instant(step.end_ns, utc)}
            for step in found.steps
        ],
        "images": {
            **asdict(found.frames),
            "first": _format_instant(found.frames.first_ns, utc),
            "last": _format_instant(found.frames.last_ns, utc),
        },
        "channels": [
            {name: None if value != value else value for name, value in asdict(channel).items()}
            for channel in found.channels
        ],
        "gaps": [
            {**asdict(gap), "begin": _format_instant(gap.begin_ns, utc), "end": _format_instant(gap.end_ns, utc)}
            for gap in found.gaps
        ],
        "events": [{**asdict(event), "time": _format_instant(event.time_ns, utc)} for event in found.events],
    }


def format_verification(found: Scan) -> Iterator[str]:
    """`stand session verify`: the findings, then what was read."""
    yield from map(escape_line, summarise_findings(found.findings))
    errors = sum(finding.severity == "error" for finding in found.findings)
    count = f" ({errors} {'error' if errors == 1 else 'errors'})" if errors else ""
    yield (
        f"files {found.files}{count}; run {found.run}; {found.segments} segments, {found.messages} messages, "
        f"{found.frames} frames, {format_size(found.bytes)} read"
    )


def make_verification_json(found: Scan) -> dict[str, object]:
    """`stand session verify --json`."""
    counts = {name: getattr(found, name) for name in ("segments", "messages", "frames", "bytes")}
    findings = [asdict(finding) for finding in found.findings]
    return {"sound": found.is_sound, "files": str(found.files), "run": str(found.run), "findings": findings, **counts}
