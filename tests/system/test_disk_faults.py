"""A disk that acknowledged what it did not write, or wrote it elsewhere, or forgot it: over all that the stand keeps.

Each state is one drawn fault (disk_faults.py) of a folder in which everything is: a run that has tripped, one that was
killed, the queue, counters, compressor, latch, tokens, what was learned, the index of sessions. It is then looked at by
the programs: what is not damaged has its true value and is not blamed, what is damaged is named and counts for nothing.
"""

import asyncio
import json
import os
import shutil
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.journals import read_lines
from tests.nightly import mark_nightly
from tests.recording.damage import read_segment
from tests.recording.device_declarations import declare_devices
from tests.system.disk_faults import KINDS, kind_of, put_back, states, tree_of
from tests.system.test_kill_recording import read_series
from thermostand.foundation.clock import NS_PER_S, Boot, VirtualClock
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.foundation.sealed import seal
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.manifest import SessionInfo
from thermostand.recording.reading.notes import add_note, add_tags, read_notes
from thermostand.recording.writing.recorder import Recorder
from thermostand.recording.writing.recorder_settings import RecordingSettings
from thermostand.stand.chamber.compressor import CompressorState, load_state, save_state
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.interface_section import TokenFile, load_tokens, write_tokens
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.estimating.learned_durations import LearnedDurations, load_learned_durations
from thermostand.stand.running.memory.entries import Ended, Held, Soaked, StepChanged, Tripped
from thermostand.stand.running.memory.journal import JOURNAL_NAME, Journal
from thermostand.stand.running.opening.stand_lock import find_latch_file
from thermostand.stand.running.order import load_order
from thermostand.stand.running.resume import load_interruption, make_begin_entry
from thermostand.stand.safety.fault import Fault
from thermostand.stand.service import queue
from thermostand.stand.service.counters import StoredCounters, load_counters

START_NS = 1_767_290_400 * NS_PER_S
TRIPPED, KILLED = "20260101T180000Z-tripped", "20260102T180000Z-killed"
SECONDS = 30
BY_DAY, NIGHTLY = 6, 150  # seeds, each of every kind
SOUND_ONES = 8  # of so many states in which nothing of a session is hit one is read all the same
NOW_NS, BOOT = START_NS + 9_000_000 * NS_PER_S, Boot("b007", 0)
SETTINGS = RecordingSettings(segment_s=11.0, stop_frames_below_bytes=0, alert_below_fraction=0.0)
RUNNER = CliRunner()


def items(order, index, time_ns, name):
    """A second of a run whose step number `index` is done in it."""
    step_id = list(order.recipe.plan())[index].step_id
    if not index:
        yield Event(time_ns, "info", "run.start", "", {"steps": 40, "frames": SECONDS, "plan": "", "seed": 7})
    yield StepMark(time_ns, step_id, index, "capture", StepState.STARTED, {})
    yield Batch("thermometers", time_ns, (Reading("thermometers.air", 20 + index / 8, "degC", time_ns),))
    image = np.random.default_rng(index + len(name)).integers(0, 255, (60, 60), np.uint8)
    yield Frame("camera.image", image, time_ns - NS_PER_S // 10, 0.1, 0.0, 41.0, index, 7 * index, 0, step_id)
    yield StepMark(time_ns, step_id, index, "capture", StepState.DONE, {})
    if name == TRIPPED and index == SECONDS - 1:
        yield Event(time_ns, "error", "run.end", "too hot", {"status": "tripped"})


def entries_of(index, time_ns, name, order):
    """What the run writes into its journal in that second."""
    step_id = list(order.recipe.plan())[index].step_id
    yield StepChanged(time_ns, step_id, "started")
    yield Held(time_ns, "disk", True)
    yield Held(time_ns, "disk", False)
    yield Soaked(time_ns, step_id, float(index))
    yield StepChanged(time_ns, step_id, "done")
    if name == TRIPPED and index == SECONDS - 1:
        yield Tripped(time_ns, "over_temperature", "too hot")
        yield Ended(time_ns, "tripped", "too hot")


async def recorded(directory, order, start_ns, each_second):
    """A run in `directory`, killed unless it trips; `each_second` is called after each."""
    name, clock, hub = directory.name, VirtualClock(start_ns), Hub()
    info = SessionInfo(name, "demo", "DA1234567", "M. Adamczyk", "0.1.0", "virtual", simulated=True)
    devices = declare_devices({"thermometers": "thermometers", "camera": "camera"})
    recorder = Recorder(directory, info, order.attachments(), devices, hub, clock, settings=SETTINGS)
    recorder.start()
    journal = Journal.create(directory)
    journal.start(clock, print)
    tasks = [asyncio.create_task(recorder.run()), asyncio.create_task(clock.run())]
    await journal.write(make_begin_entry(order, name, start_ns, 7))
    for index in range(SECONDS):
        await clock.sleep_until(start_ns + index * NS_PER_S)
        for item in items(order, index, clock.now_ns(), name):
            hub.publish(item)
        await clock.sleep_until(start_ns + index * NS_PER_S + NS_PER_S // 2)
        await journal.write(*entries_of(index, clock.now_ns(), name, order))
        each_second(index)
    tasks[0].cancel()
    with suppress(asyncio.CancelledError):
        await tasks[0]
    left = tree_of(directory)  # by one that is killed here
    await recorder.finish()
    tasks[1].cancel()
    await journal.close()
    if name == KILLED:
        shutil.rmtree(directory)
        put_back(left, directory)


class Stand:
    """All that is kept of one stand, in a folder of its own: `before` at earlier flushes, and `now`."""

    def __init__(self, root: Path) -> None:
        self.root, self.sessions, self.tokens = root, root / "sessions", root / "tokens.yaml"
        self.order = load_order("demo", "simulated")
        self.latch = find_latch_file(load_config(find_packaged("", "simulated")))
        self.before = []
        self.sessions.mkdir(parents=True)
        for number in range(4):
            self.keep(number)
        for place, name in enumerate((TRIPPED, KILLED)):
            start_ns = START_NS + place * 86_400 * NS_PER_S
            asyncio.run(recorded(self.sessions / name, self.order, start_ns, self.note))
        add_tags(self.sessions / TRIPPED, ["keep"], "eva", START_NS)
        self.snap()
        for number in range(8):
            add_note(self.sessions / TRIPPED, f"note {number} " + "of the night " * 12, "eva", START_NS + number)
            add_note(self.sessions / KILLED, f"word {number} " + "of the night " * 12, "jan", START_NS + number)
        self.snap()
        self.keep(4)
        self.latch.keep(Fault("over_temperature", "too hot"), START_NS)
        self.listed = self.program("session", "list", self.sessions, "--json").stdout
        self.now = tree_of(root)
        self.times = {name: (root / name).stat().st_mtime_ns for name in self.now}
        self.truth = {name: self.series_of(self.sessions / name) for name in (TRIPPED, KILLED)}
        journals = {name: self.now[f"sessions/{name}/{JOURNAL_NAME}"] for name in self.truth}
        self.entries = {name: read_lines(data)[0] for name, data in journals.items()}

    def snap(self):
        self.before.append(tree_of(self.root))

    def note(self, index):
        if index % 3 == 0:
            self.snap()

    def keep(self, number):
        """Change each small file once more."""
        queue.append(self.sessions, queue.make_entry(self.order, "simulated", START_NS + number))
        if number == 2:
            queue.take(self.sessions, START_NS + number)
        save_state(self.sessions / "compressor.json", compressor(number), BOOT)
        counters = {f"relay_cycles.{n}": float(7**number + n) for n in range(20)}
        self.write(self.sessions / "daemon.json", "counters", StoredCounters(counters=counters))
        learned = LearnedDurations(
            overheads_s={f"soak {n}": float(5**number + n) for n in range(20)}, learned_from=(str(number),)
        )
        self.write(self.sessions / "learned.json", "learned", learned)
        write_tokens(self.tokens, tokens(number))
        if number == 1:
            self.latch.keep(Fault("flap_open", "open"), 5)
        self.snap()
        if number == 2:
            self.latch.remove()

    def write(self, path, kind, model):
        path.write_bytes(seal(kind, model.model_dump_json(indent=1)))

    def program(self, *words):
        return RUNNER.invoke(app, [str(word) for word in words])

    def series_of(self, directory):
        """Each message of a session once it is salvaged, by series."""
        with_copy = self.root.parent / "repaired" / directory.name
        shutil.rmtree(with_copy.parent, ignore_errors=True)
        shutil.copytree(directory, with_copy)
        self.program("session", "repair", with_copy)
        found = {series: Counter(read_series(with_copy, series)) for series in (TELEMETRY, FRAMES)}
        shutil.rmtree(with_copy.parent)
        return found

    def restore(self):
        """Everything as it is now."""
        files = {str(path.relative_to(self.root)) for path in self.root.rglob("*") if path.is_file()}
        for name in files - self.now.keys():
            (self.root / name).unlink()
        changed = {name: data for name, data in self.now.items() if self.is_changed(name, data)}
        put_back(changed, self.root)
        self.set_times(changed)

    def is_changed(self, name, data):
        path = self.root / name
        return not path.exists() or path.stat().st_mtime_ns != self.times[name] or path.read_bytes() != data

    def set_times(self, names):
        """A disk that lies does not change a file's times."""
        for name in names:
            if name in self.times and (self.root / name).exists():
                os.utime(self.root / name, ns=(self.times[name], self.times[name]))

    def apply(self, state):
        self.restore()
        for name in state.hit:
            if name in state.tree:
                put_back({name: state.tree[name]}, self.root)
            else:
                (self.root / name).unlink()
        self.set_times(state.hit)


def compressor(number):
    return CompressorState(running=False, since_ns=(1000 + number) * NS_PER_S, starts_ns=((900 + number) * NS_PER_S,))


def tokens(number):
    return TokenFile(tokens={"eva": "e" * 30, f"user-{number}": f"{number}" * 30}, read_only={"wall": "w" * 40})


@pytest.fixture(scope="module")
def stand(tmp_path_factory):
    root = tmp_path_factory.mktemp("stand") / "kept"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(root / "state"))
        yield Stand(root)


def problems(stand, state):
    """What is wrong with how the programs take this state, as sentences."""
    stand.apply(state)
    names = {Path(name).name for name in state.hit}
    yield from small_files(stand, state, names)
    yield from listed(stand, state)
    for name in (TRIPPED, KILLED):
        hit = {each.removeprefix(f"sessions/{name}/") for each in state.hit if each.startswith(f"sessions/{name}/")}
        if hit or state.seed % SOUND_ONES == 0:
            yield from verified(stand, name, hit, state)
            yield from salvaged(stand, name, hit, state)


def small_files(stand, state, names):
    fault = stand.latch.read()
    if fault is None:
        yield "the latch is lost: the stand would heat"
    elif not any(name.endswith(".latched.json") for name in names) and fault.text != "too hot":
        yield "a latch that is not damaged is not read"
    found = load_state(stand.sessions / "compressor.json", NOW_NS, BOOT)
    true = compressor(4) if "compressor.json" not in names else None
    earlier = [compressor(n) for n in range(4)] if "sessions/compressor.json" in state.gone_back else []
    unknown = CompressorState(False, NOW_NS)
    if found not in ([true] if true else [unknown, compressor(4), *earlier]):
        yield f"compressor {found}"
    kept, damage = load_counters(stand.sessions)
    if not damage and kept.counters not in counted(4, "sessions/daemon.json", state):
        yield "counters are wrong and nothing says so"
    if damage and "daemon.json" not in names:
        yield "sound counters are blamed"
    learned = load_learned_durations(stand.sessions)
    if learned.learned_from not in [("4",), *([(), ("3",)] if "learned.json" in names else [])]:
        yield f"learned {learned.learned_from}"
    if learned.learned_from == ("4",) and learned.overheads_s != {f"soak {n}": float(625 + n) for n in range(20)}:
        yield "what was learned is wrong and nothing says so"
    yield from queued(stand, names)
    with suppress(ConfigError):
        if load_tokens(stand.tokens) != tokens(4) and "tokens.yaml" not in names:
            yield "tokens that are not damaged are not read"
        return
    if "tokens.yaml" not in names:
        yield "sound tokens are blamed"


def counted(number, name, state):
    """The true counters, and what they were where the disk went back to that."""
    true = [{f"relay_cycles.{n}": float(7**k + n) for n in range(20)} for k in range(number + 1)]
    return [*true, {}] if name in state.gone_back else true[-1:]


def queued(stand, names):
    its = names & {"queue.json", "queue.json.last"}
    try:
        runs = [(entry.id, entry.state.value) for entry in queue.load_queue(stand.sessions).entries]
    except SessionError as error:
        if not its:
            yield "a sound queue is blamed"
        elif "queue.json" not in str(error):
            yield f"queue: {error}"
        return
    if runs != [(1, "interrupted"), *((n, "waiting") for n in range(2, 6))]:
        yield f"the queue is {runs} and nothing says so"


def traceback_in(answer):
    if answer.exception is not None and not isinstance(answer.exception, SystemExit):
        yield f"{answer.exception!r}"
    if (
        answer.exit_code not in (0, 1, 2)
        or "Traceback" in answer.output
        or (answer.exit_code and not answer.output.strip())
    ):
        yield f"exit {answer.exit_code}: {answer.output[-300:]}"


def listed(stand, state):
    answer = stand.program("session", "list", stand.sessions, "--json")
    yield from traceback_in(answer)
    is_whole = not any(f"/{name}/" in each for name in (TRIPPED, KILLED) for each in state.hit)
    if answer.exit_code == 0 and is_whole and json.loads(answer.stdout) != json.loads(stand.listed):
        yield "the list is wrong and nothing says so"


def verified(stand, name, hit, state):
    directory = stand.sessions / name
    answer = stand.program("session", "verify", directory, "--json")
    yield from traceback_in(answer)
    if answer.exit_code == 2 or not answer.stdout:
        return
    found = json.loads(answer.stdout)["findings"]
    blamed = {each["where"] for each in found if each["severity"] == "error"} - {""}
    noted = {each["where"] for each in found}
    unfinished = {each for each in blamed if each.endswith(".part")}
    allowed = hit | {each.replace(".mcap.part", ".mcap") for each in hit} | unfinished
    for each in blamed - allowed:
        yield f"verify {name}: {each} is blamed"
    shown = {each for each in hit if f"sessions/{name}/{each}" not in state.gone_back}
    for each in shown - noted - unfinished:
        yield f"verify {name}: {each} is damaged and not named"


def salvaged(stand, name, hit, state):
    """What a salvage and a resumption make of it."""
    scratch = stand.root.parent / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    directory = shutil.copytree(stand.sessions / name, scratch / name)
    yield from journalled(stand, name, directory, hit)
    answer = stand.program("session", "repair", directory)
    yield from traceback_in(answer)
    for series, true in stand.truth[name].items():
        segments = [Counter(read_segment(path)) for path in sorted((directory / series).glob("*.mcap"))]
        # One of which all but the opening is another's is not told from its own; `verify` says that it is damaged.
        found = sum((each for each in segments if each & true), Counter())
        if more := found - true:
            yield f"salvage {name}: {more.total()} messages of {series} were never recorded there, or once only"
        if found != true and not any(each.startswith(series) for each in hit):
            yield f"salvage {name}: {series} is not damaged and lacks messages"
    notes = read_notes(directory)
    texts = [note.text.strip() for note in notes.notes]
    word = "note" if name == TRIPPED else "word"
    true_texts = [(f"{word} {number} " + "of the night " * 12).strip() for number in range(8)]
    is_hit = "notes.jsonl" in hit
    is_anothers = is_hit and not any(text.startswith(word) for text in texts)  # all of it: it names no session
    is_wrong = texts != [text for text in true_texts if text in texts] or (texts != true_texts and not is_hit)
    if is_wrong and not is_anothers:
        yield f"notes of {name}: {[text[:6] for text in texts]}"
    yield from traceback_in(stand.program("session", "info", directory))


def journalled(stand, name, directory, hit):
    true, path = iter(stand.entries[name]), directory / JOURNAL_NAME
    if path.exists() and not all(entry in true for entry in read_lines(path.read_bytes())[0]):
        yield f"journal of {name}: entries count that were never written there, or are out of order"
    try:
        before = load_interruption(directory)
    except SessionError as error:
        if name == TRIPPED and not hit and "tripped" not in str(error):
            yield f"resume: {error}"
        if name == KILLED and not hit:
            yield f"a run that may be resumed is not: {error}"
        return
    before.release()
    if name == TRIPPED:
        yield "a run that has tripped is resumed without --reset"


def judge(stand, chosen):
    """The states that were tried by kind and by file, and what was found."""
    tried, found = Counter(), []
    for state in chosen:
        tried.update((state.kind, kind_of(name)) for name in state.hit)
        found += [f"{state.kind}: {state.text}: {problem}" for problem in problems(stand, state)]
    stand.restore()
    return tried, found


@pytest.mark.parametrize("seeds", [range(BY_DAY), mark_nightly(range(BY_DAY, NIGHTLY))])
def test_what_the_disk_has_spoilt_is_named_and_the_rest_is_as_it_was(stand, seeds):
    tried, found = judge(stand, states(stand.before, stand.now, seeds))
    assert found == []
    assert {kind for kind, _ in tried} == set(KINDS)
