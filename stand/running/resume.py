"""What a session says of a run that did not come to its end, and whether it may be resumed.

The journal says what was done, the recording what it produced: a step whose end is recorded is done, and a frame
counts when its image and its description are both on the disk. What only the recording proves is put between the
journal's entries, and all of them are folded into the state from which the run is resumed. Recipe, seed and target are
those of the session, not today's files; the stand is this one (see the settings that are kept below).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import Any, cast

from thermostand.drivers.settings import CameraSettings, OnBus
from thermostand.experiments.steps import Capture, PlannedStep
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.events import PLAN_CHANGED, RUN_BEGINS, RUN_END
from thermostand.foundation.items import Event, Item, StepMark, StepState
from thermostand.foundation.progress import show_late_progress
from thermostand.recording.format.capture_restarts import count_frames_lost, find_restarted_step
from thermostand.recording.format.journal_lines import hash_text
from thermostand.recording.format.manifest import SessionInfo
from thermostand.recording.reading.recorded_devices import recorded_devices
from thermostand.recording.reading.run_status import RunOutcome, find_last_run_event
from thermostand.recording.reading.scan import scan
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import BEING_RECORDED, Salvaged, salvage_unfinished
from thermostand.stand.assembly.assemble import list_recorded_devices as declared_devices
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.executing.actions import find_cold_start_steps
from thermostand.stand.running.executing.camera_gap import CameraHistory, load_camera_history
from thermostand.stand.running.memory.entries import (
    Begun,
    Ended,
    Entry,
    JournalEntry,
    Restarted,
    StepChanged,
    Taken,
    Tripped,
    parse_change,
)
from thermostand.stand.running.memory.fold import apply_entry, fold
from thermostand.stand.running.memory.journal import JOURNAL_NAME, Journal
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.order import Order, parse_order

# A session that is resumed brings its experiment, never its stand: it may be somebody else's, and what it names would
# be run and opened here.
#
# The programs that are run, the files and folders, the addresses, and all that protects the stand are those of this
# stand's own configuration. Of the session's remain recipe, seed and target, and what its frames depend on.

# Of the camera and the recording: frames before and after the interruption belong together.
_CAMERA = (
    "pixel_format",
    "width_px",
    "height_px",
    "offset_x_px",
    "offset_y_px",
    "binning",
    "exposure_s",
    "gain_dB",
    "trigger",
    "frame_rate_hz",
    "temperature",
    "has_temperature",
)
_RECORDING = ("frame_encoding", "whole_every_s")
_LONGEST_VALUE = 200  # characters of a value that a sentence shows


@dataclass(frozen=True, slots=True)
class Difference:
    """What the session's configuration has at `path`, and what this stand's has, as JSON-able values."""

    path: str
    session: object
    stand: object

    def __str__(self) -> str:
        other = "and not given in" if self.session is None else f"not {_format_value(self.session)} as in"
        return f"{self.path} is {_format_value(self.stand)} as on this stand, {other} the session"

    def data(self) -> dict[str, object]:
        """The differences as data for the recording."""
        return {"path": self.path, "session": self.session, "stand": self.stand}


def load_default_stand() -> StandConfig:
    """Load the installed simulated stand when no configuration is named, as for a new run."""
    return load_config(find_packaged("", "simulated"))


def make_resume_config(
    recorded: StandConfig, own: StandConfig, session: Path, *, is_virtual: bool
) -> tuple[StandConfig, tuple[Difference, ...]]:
    """The configuration with which a session is resumed here, and how it differs from the recorded one.

    In virtual time the session's own laboratory is simulated, which has no addresses to mistake: only programs, files
    and folders are this stand's. ConfigError when one stand is real and the other simulated.
    """
    if is_virtual:
        config = _adapt_virtual_time(recorded, own)
    else:
        _check_kind(recorded, own, session)
        config = own.model_copy(
            update={
                "target": recorded.target,
                "cameras": _merge_cameras(recorded, own, session),
                "recording": own.recording.model_copy(
                    update={name: getattr(recorded.recording, name) for name in _RECORDING}
                ),
            }
        )
    return config, tuple(_find_differences(recorded.model_dump(mode="json"), config.model_dump(mode="json")))


def _adapt_virtual_time(recorded: StandConfig, own: StandConfig) -> StandConfig:
    simulated = own if own.simulation is not None else load_default_stand()
    maps = {
        name: settings.model_copy(
            update={
                "registers": simulated.units[kind.section].registers
                if kind.section in simulated.units
                else kind.simulated_map
            }
        )
        for name, kind, settings in recorded.equipment
        if isinstance(settings, OnBus)
    }
    state_file = {"state_file": simulated.compressor.state_file}
    return recorded.model_copy(
        update={
            **recorded.replace_settings(maps),
            "alerts": own.alerts,
            "compressor": recorded.compressor.model_copy(update=state_file),
            "recording": recorded.recording.model_copy(update={"directory": own.recording.directory}),
            "flap": recorded.flap
            and recorded.flap.model_copy(update={"backend": simulated.flap and simulated.flap.backend}),
        }
    )


def _merge_cameras(recorded: StandConfig, own: StandConfig, session: Path) -> dict[str, CameraSettings]:
    """Merge the cameras of the session, by its names: where they are found is this stand's, what its frames depend on
    the session's."""
    if missing := recorded.cameras.keys() - own.cameras.keys():
        raise ConfigError(
            f"{session}: was recorded with a camera {min(missing)}, and {own.name!r} has none of that name"
        )
    return {
        name: own.cameras[name].model_copy(
            update={key: getattr(camera, key) for key in _CAMERA if key in type(camera).model_fields}
        )
        for name, camera in recorded.cameras.items()
    }


def _check_kind(recorded: StandConfig, own: StandConfig, session: Path) -> None:
    if (recorded.simulation is None) != (own.simulation is None):
        kinds = {True: "a real stand", False: "a simulated one"}
        raise ConfigError(
            f"{session}: was recorded on {kinds[recorded.simulation is None]}, and {own.name!r} is "
            f"{kinds[own.simulation is None]}; give this stand's configuration with --config"
        )


def _find_differences(before: Mapping[str, Any], now: Mapping[str, Any], above: str = "") -> Iterator[Difference]:
    """Every value that is not the same, by its path; what one of both has not at all, such as a thermometer of that
    name, as a whole."""
    for name in dict.fromkeys((*before, *now)):
        value, own, path = before.get(name), now.get(name), f"{above}{name}"
        if isinstance(value, dict) and isinstance(own, dict):
            yield from _find_differences(cast("dict[str, Any]", value), cast("dict[str, Any]", own), f"{path}.")
        elif value != own:
            yield Difference(path, value, own)


def _format_value(value: object) -> str:
    text = "not given" if value is None else json.dumps(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def make_begin_entry(order: Order, run: str, time_ns: int, seed: int | None) -> Begun:
    """The first line of a run's journal."""
    return Begun(time_ns, run, hash_plan(order.recipe.plan()), _hash_texts(order.attachments()), seed)


def hash_plan(plan: Iterable[PlannedStep]) -> str:
    """The same for the same steps in the same order."""
    return hashlib.sha256("\n".join(planned.step_id for planned in plan).encode()).hexdigest()[:16]


def _hash_texts(texts: Mapping[str, str]) -> dict[str, str]:
    return {name: hash_text(text) for name, text in texts.items()}


@dataclass(frozen=True, slots=True)
class Interruption:
    """A run that may be resumed. Its journal is open, and so locked, until it is run or `release`d.

    state: by journal and recording. last_ns: the last instant on the disk. seed: of the simulated laboratory.
    tripped: what an operator has reset. salvaged: what had to be finished first. camera: what the session records of
    it. utc_offset_ns: UTC minus the stand's clock at last_ns, as it is recorded. differences: between the configuration
    of the session and that of this stand, with which it is resumed.
    """

    directory: Path
    order: Order
    info: SessionInfo
    journal: Journal
    state: RunState
    last_ns: int
    seed: int | None
    salvaged: tuple[Salvaged, ...]
    camera: CameraHistory
    utc_offset_ns: int = 0
    differences: tuple[Difference, ...] = ()

    @property
    def kept(self) -> RunState:
        """What counts of it: without the steps of a warm-up that is restarted."""
        again = [planned.step_id for planned in find_cold_start_steps(self.state)]
        return apply_entry(self.state, Restarted(self.last_ns, again)) if again else self.state

    def release(self) -> None:
        """Give the session free for another daemon; may be called twice."""
        self.journal.release()


def repair_session(directory: Path) -> tuple[Salvaged, ...]:
    """Return what `load_interruption` would have to write: the journal's partial last line is cut off, unfinished
    segments are finished. SessionError as there. For the process that touches the disk; those that are being recorded
    are not among them."""
    Journal.open(directory)[0].release()
    found = salvage_unfinished(directory.resolve().parent)
    return tuple(segment for segment in found if segment.reason != BEING_RECORDED)


def load_interruption(directory: Path, own: StandConfig | None = None, *, reset: bool = False) -> Interruption:
    """Return what is needed to resume the run recorded in `directory` on this stand, the installed simulated one when
    no `own` is given; its unfinished segments are salvaged.

    ConfigError when only one of the two stands is simulated. SessionError when a daemon is running it, it is complete,
    it tripped and `reset` is not given, or journal, recording and this version of the program do not belong together.
    """
    journal, entries = Journal.open(directory)
    try:
        return _load(directory, journal, entries, own or load_default_stand(), reset)
    except BaseException:
        journal.release()
        raise


def _load(
    directory: Path, journal: Journal, entries: list[JournalEntry], own: StandConfig, reset: bool
) -> Interruption:
    first = entries[0] if entries else None
    if not entries or not (isinstance(first, Begun) or journal.damage):
        raise SessionError(f"{directory}: its run had not begun when it was killed; begin a new run")
    _check_may_go_on(directory, fold_entries((), entries), reset)
    with show_late_progress("repair", 1.0) as report:
        salvaged = tuple(salvage_unfinished(directory.resolve().parent, report))
    session = Session.open(directory)
    begun = first if isinstance(first, Begun) else _read_begin(session)
    lost = _read_end(session, entries)
    items = (*session.steps(), *session.events())
    without_frames = (*merge_recorded(entries, items, ()), *lost)
    _check_may_go_on(directory, fold_entries((), without_frames), reset)
    order = _load_order(session, begun)
    plan = fold_entries(order.recipe.plan(), without_frames).plan
    all_entries = (*merge_recorded(entries, items, _read_frames(session, plan)), *lost)
    info = SessionInfo.of(session.metadata)
    config, differences = make_resume_config(order.config, own, directory, is_virtual=info.clock_source == "virtual")
    differences = (*differences, *_changed_units(session, config))
    last_ns = max(entries[-1].time_ns, scan(directory).end_ns or 0)
    return Interruption(
        directory,
        replace(order, config=config),
        info,
        journal,
        fold_entries(order.recipe.plan(), all_entries),
        last_ns,
        begun.seed,
        salvaged,
        load_camera_history(session),
        session.utc.at(last_ns),
        differences,
    )


def _changed_units(session: Session, config: StandConfig) -> Iterator[Difference]:
    """Channels that a device of this stand measures in another unit than it did in the session; what follows is kept
    apart from what there is (`disambiguate_channel`)."""
    before = recorded_devices(session.telemetry_segments)
    for name, device in declared_devices(config).items():
        units = {each.name: each.unit for each in before[name].channels} if name in before else {}
        for each in device.channels:
            if units.get(each.name, each.unit) != each.unit:
                yield Difference(f"the unit of {name}.{each.name}", units[each.name], each.unit)


def fold_entries(plan: Iterable[PlannedStep], entries: Iterable[Entry]) -> RunState:
    """The state, of entries that may be anybody's; SessionError when they are not what a run has written."""
    try:
        return fold(plan, entries)
    except (TypeError, ValueError, LookupError, AttributeError, OverflowError) as error:
        raise SessionError(f"{JOURNAL_NAME}: no run has written such entries ({error}); begin a new run") from error


def _check_may_go_on(directory: Path, state: RunState, reset: bool) -> None:
    """SessionError when the run is complete, or has tripped and was not reset."""
    if state.ended is not None and state.ended.status == RunOutcome.COMPLETE:
        raise SessionError(f"{directory}: its run is complete; there is nothing to resume")
    if state.tripped and not reset:
        raise SessionError(f"{directory}: the stand tripped: {state.tripped}; look into it, then resume with --reset")


def merge_recorded(entries: Sequence[Entry], items: Iterable[Item], frames: Iterable[tuple[int, str]]) -> list[Entry]:
    """The entries of a journal, and between them what only the recording proves: by `items` steps that are done,
    captures that were restarted and changes of the plan, by `frames` (instant and step of each) what was captured."""
    done: list[Entry] = []
    others: list[Entry] = [Taken(time_ns, step_id) for time_ns, step_id in frames]
    known = {
        (entry.time_ns, step_id) for entry in entries if isinstance(entry, Restarted) for step_id in entry.step_ids
    }
    for item in items:
        if isinstance(item, StepMark) and item.state is StepState.DONE:
            done.append(StepChanged(item.time_ns, item.step_id, "done"))
        if isinstance(item, Event):
            step_id = find_restarted_step(item)
            if step_id and (item.time_ns, step_id) not in known:
                others.append(Restarted(item.time_ns, [step_id], count_frames_lost(item)))
            change = parse_change(item.time_ns, item.data) if item.kind == PLAN_CHANGED else None
            if change is not None and change not in entries:
                others.append(change)
    instant = attrgetter("time_ns")
    others.sort(key=instant)
    # Of an instant in which steps are to be done again, their ends before do not count, their frames do.
    return list(merge(sorted(done, key=instant), entries, others, key=instant))


def _read_frames(session: Session, plan: Iterable[PlannedStep]) -> list[tuple[int, str]]:
    """Instant and step of the captures' frames that are on the disk; looks are none. Of several cameras those of the
    one with the fewest: it is the last to have its frame."""
    metas = session.frame_metas()
    channels = dict.fromkeys(meta.channel for meta in metas)
    found: list[tuple[int, str]] = []
    for planned in plan:
        if isinstance(planned.step, Capture):
            of_it = [meta for meta in metas if meta.step_id == planned.step_id]
            own = [f"{name}.image" for name in planned.step.cameras] or channels
            taken = [[meta.time_ns for meta in of_it if meta.channel == channel] for channel in own]
            found += [(time_ns, planned.step_id) for time_ns in min(taken, key=len, default=[])]
    return found


def _read_end(session: Session, entries: Sequence[Entry]) -> tuple[Entry, ...]:
    """The end of the run by the recording, when its journal has lost that: it says so in damaged lines, or not at all
    when it is the last flush that the disk has lost."""
    event = find_last_run_event(session.events())
    if isinstance(entries[-1], Ended) or event is None or event.kind != RUN_END or event.time_ns < entries[-1].time_ns:
        return ()
    status = event.data.get("status")
    if status == RunOutcome.TRIPPED:
        return (Tripped(event.time_ns, "", event.text), Ended(event.time_ns, "tripped", event.text))
    return (Ended(event.time_ns, "complete", event.text),) if status == RunOutcome.COMPLETE else ()


def _read_begin(session: Session) -> Begun:
    """The first line of a journal that has lost it, from what the recording says; SessionError when it does not."""
    for event in session.events():
        plan, seed = event.data.get("plan"), event.data.get("seed")
        if event.kind in RUN_BEGINS and isinstance(plan, str) and isinstance(seed, int | None):
            texts = _hash_texts(session.attachments)
            return Begun(event.time_ns, session.metadata.get("session_id", ""), plan, texts, seed)
    raise SessionError(
        f"{session.path}: the line of its journal that says what was run is damaged, and the recording does not say "
        "it; begin a new run"
    )


def _load_order(session: Session, first: Begun) -> Order:
    """Return what was to be run, from the texts in the session; SessionError when they are not those the run began
    with."""
    texts = dict(session.attachments)
    if _hash_texts(texts) != first.texts:
        raise SessionError(f"{session.path}: the attached files are not those its run began with")
    order = parse_order(texts, {name: f"{session.path}: {name}" for name in texts})
    if hash_plan(order.recipe.plan()) != first.plan:
        raise SessionError(
            f"{session.path}: this version of thermostand makes another plan of its recipe; begin a new run"
        )
    return order


def is_of_virtual_time(before: Interruption | None) -> bool:
    """Return whether an interrupted run was one in virtual time, in which it is then resumed."""
    return before is not None and before.info.clock_source == "virtual"
