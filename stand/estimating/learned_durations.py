"""Durations learned from the last sessions in a folder, kept in a file next to them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import median

from pydantic import Field

from thermostand.experiments.steps import Situation, Step, make_step
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.documents import Document, parse_yaml
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.files import replace_file
from thermostand.foundation.items import StepMark, StepState
from thermostand.foundation.sealed import seal, unseal
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.chamber_model import ChamberModel, Ramp, extract_ramps, fit_chamber_model
from thermostand.stand.estimating.durations import ConfiguredStand, price_step

LEARNED_FILE = "learned.json"
_KIND = "learned"
_MOST_SESSIONS = 5  # as far back as a stand is likely to be as it is now


class LearnedDurations(Document):
    """The chamber's model, and per kind of work (durations.Expectation) what it takes beyond what is stated, s.

    `learned_from`: the sessions it is learned from, none when all are defaults.
    """

    chamber: ChamberModel = ChamberModel()
    overheads_s: dict[str, float] = Field(default_factory=dict)
    learned_from: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line about where the estimates come from."""
        if not self.learned_from:
            return "estimates are defaults; they are learned from recorded runs"
        model = self.chamber
        return (
            f"estimates as learned from {len(self.learned_from)} runs, the last {self.learned_from[-1]} "
            f"({model.heating_ramps} ramps up, {model.cooling_ramps} down)"
        )


def load_learned_durations(directory: Path) -> LearnedDurations:
    """Return what is kept in `directory`; defaults when there is nothing or nothing that can be read: an estimate is no
    reason not to run, and the file is rewritten at the end of each."""
    try:
        return LearnedDurations.model_validate_json(unseal(_KIND, (directory / LEARNED_FILE).read_bytes()))
    except (OSError, ValueError):
        return LearnedDurations()


@dataclass(frozen=True, slots=True)
class _SessionDurations:
    """What a session teaches."""

    name: str
    marks: list[StepMark]
    ramps: list[Ramp]


def learn_durations(directory: Path, config: StandConfig) -> LearnedDurations:
    """Learn from the last sessions of this stand (by its name) in `directory`, and keep it there.

    Sessions that cannot be read teach nothing. The file is replaced at once or not at all; SessionError when the disk
    refuses.
    """
    sessions = list(islice(_iterate_sessions(directory, config), _MOST_SESSIONS))
    if not sessions:
        return load_learned_durations(directory)
    seen_s: defaultdict[str, list[float]] = defaultdict(list)
    chamber = fit_chamber_model([ramp for estimate in sessions for ramp in estimate.ramps])
    for each in sessions:
        for work, overhead_s in compute_overheads(each.marks, config, chamber):
            seen_s[work].append(overhead_s)
    learned = LearnedDurations(
        chamber=chamber,
        overheads_s={work: round(median(values_s), 3) for work, values_s in sorted(seen_s.items())},
        learned_from=tuple(sorted(each.name for each in sessions)),
    )
    _replace(directory / LEARNED_FILE, learned.model_dump_json(indent=2))
    return learned


def compute_overheads(
    marks: Iterable[StepMark], config: StandConfig, chamber: ChamberModel | None = None
) -> list[tuple[str, float]]:
    """(kind of work, s beyond what is stated) of every step of a session that was done in one go, in order; `config` is
    the stand's as it is now, `chamber` its model. Steps that are not known any more are left out."""
    stand, found, overheads = ConfiguredStand(config, chamber), Situation(), list[tuple[str, float]]()
    for mark, duration_s in _pair_durations(marks):
        step = _make_step(mark)
        if step is None:
            continue
        if duration_s is not None:
            expected = price_step(step, found, stand)
            overheads.append((expected.work, duration_s - expected.stated_s))
        found = step.situation_after(found)
    return overheads


def _make_step(mark: StepMark) -> Step | None:
    try:
        return make_step(mark.kind, mark.parameters)
    except ConfigError:  # recorded when this kind of step had other parameters
        return None


def _iterate_sessions(directory: Path, config: StandConfig) -> Iterator[_SessionDurations]:
    """The readable sessions of the stand of that name, the last one first; their names begin with the time."""
    for path in sorted(directory.glob("*/"), reverse=True):
        if (estimate := _read_session(path, config.name)) is not None:
            yield estimate


def _read_session(path: Path, stand: str) -> _SessionDurations | None:
    """Return what the session teaches; None when it is another stand's, or cannot be read for any reason: a neighbour
    in the folder never ends a run."""
    try:
        session = Session.open(path)
        if read_stand_name(session.attachment("config.yaml") or "") == stand:
            return _SessionDurations(path.name, session.steps(), extract_ramps(session))
    except Exception:  # noqa: BLE001 - anybody may have written it, and one unreadable session must not cost a run
        pass
    return None


def read_stand_name(config_text: str) -> str | None:
    """The stand's name in the text of a configuration of any version, as it is written there; None when there is
    none. ConfigError for what is no YAML."""
    recorded = parse_yaml(config_text, "config.yaml")
    name = recorded.get("name") if isinstance(recorded, dict) else None
    return name if isinstance(name, str) else None


def _pair_durations(marks: Iterable[StepMark]) -> Iterator[tuple[StepMark, float | None]]:
    """The marks of steps that ended well, each with its duration, s; None when it was interrupted and begun again."""
    begun_ns: dict[int, int | None] = {}
    for mark in marks:
        if mark.state is StepState.STARTED:
            begun_ns[mark.index] = None if mark.index in begun_ns else mark.time_ns
            continue
        start_ns = begun_ns.pop(mark.index, None)
        if mark.state is StepState.DONE:
            yield mark, None if start_ns is None else (mark.time_ns - start_ns) / NS_PER_S


def _replace(path: Path, text: str) -> None:
    try:
        replace_file(path, seal(_KIND, text))
    except OSError as error:
        raise SessionError(f"{path}: cannot be written ({error.strerror})") from error
