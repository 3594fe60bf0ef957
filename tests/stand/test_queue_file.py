"""The persistent queue against a plain list, several processes, and a disk that has damaged it."""

import contextlib
import subprocess
import sys
import tempfile
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests import fork_server
from tests.recording.disks import limit_files
from thermostand.foundation.errors import ConfigError, SessionError, StandTripped
from thermostand.stand.running.order import Order, load_order
from thermostand.stand.service import queue
from thermostand.stand.service.queue_file import (
    KEPT_ENDED,
    LAST_NAME,
    QUEUE_NAME,
    QueueState,
    change_queue,
    lock_worker,
)

ORDER = load_order("warm-up", "simulated")


def add(directory: Path, order: Order = ORDER) -> int:
    return queue.append(directory, queue.make_entry(order, "simulated", 1)).id


def states(directory: Path) -> list[tuple[int, str]]:
    return [(entry.id, entry.state) for entry in queue.load_queue(directory).entries]


class QueueAgainstAList(RuleBasedStateMachine):
    """ended: [id, state]; running: an id; open: ids in the order they will be run."""

    @initialize()
    def begin(self) -> None:
        self.folder = tempfile.TemporaryDirectory()
        self.directory = Path(self.folder.name)
        self.ended: list[tuple[int, str]] = []
        self.running: int | None = None
        self.open: list[int] = []
        self.interrupted: set[int] = set()
        self.added = 0
        self.worker: AbstractContextManager[None] | None = None

    def teardown(self) -> None:
        if self.worker is not None:
            self.worker.__exit__(None, None, None)
        self.folder.cleanup()

    def anyone(self, data: st.DataObject) -> int:
        return data.draw(st.integers(1, self.added + 1))

    @rule()
    def add(self) -> None:
        self.added += 1
        assert add(self.directory) == self.added
        self.open.append(self.added)

    @precondition(lambda self: self.added)
    @rule(data=st.data(), position=st.integers(0, 6))
    def move(self, data: st.DataObject, position: int) -> None:
        number = self.anyone(data)
        if number in self.open and position >= 1:
            queue.move(self.directory, number, position)
            self.open.remove(number)
            self.open.insert(position - 1, number)
        else:
            with pytest.raises(SessionError):
                queue.move(self.directory, number, position)

    @precondition(lambda self: self.added)
    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        number = self.anyone(data)
        known = {*self.open, *(other for other, _ in self.ended)}
        if number in known:
            queue.remove(self.directory, number)
            self.open = [other for other in self.open if other != number]
            self.ended = [entry for entry in self.ended if entry[0] != number]
            self.interrupted.discard(number)
        else:
            with pytest.raises(SessionError):
                queue.remove(self.directory, number)

    @precondition(lambda self: self.worker is None and self.added)
    @rule()
    def daemon_starts(self) -> None:
        self.worker = lock_worker(self.directory)
        self.worker.__enter__()

    @precondition(lambda self: self.worker is not None and self.running is None)
    @rule()
    def take(self) -> None:
        entry = queue.take(self.directory, 2)
        if not self.open:
            assert entry is None
            return
        self.running = self.open.pop(0)
        assert entry is not None
        assert entry.id == self.running
        assert (entry.state is QueueState.INTERRUPTED) == (self.running in self.interrupted)

    @precondition(lambda self: self.running is not None)
    @rule(state=st.sampled_from([QueueState.DONE, QueueState.FAILED]))
    def finish(self, state: QueueState) -> None:
        assert self.running is not None
        queue.finish(self.directory, self.running, state, 3)
        self.ended.append((self.running, state))
        self.interrupted.discard(self.running)
        self.running = None

    @precondition(lambda self: self.worker is not None)
    @rule()
    def daemon_is_killed(self) -> None:
        assert self.worker is not None
        self.worker.__exit__(None, None, None)
        self.worker = None
        if self.running is not None:
            self.open.insert(0, self.running)
            self.interrupted.add(self.running)
            self.running = None

    @invariant()
    def the_file_says_what_the_list_says(self) -> None:
        running = [] if self.running is None else [(self.running, "running")]
        waiting = [(number, "interrupted" if number in self.interrupted else "waiting") for number in self.open]
        assert states(self.directory) == [*self.ended, *running, *waiting]


TestQueueAgainstAList = QueueAgainstAList.TestCase
TestQueueAgainstAList.settings = settings(max_examples=25, stateful_step_count=25, deadline=None, derandomize=True)


def test_what_is_queued_is_what_the_files_were_when_they_were_added(tmp_path: Path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("name: mine\nexperiments: [{warm_up: {}}]\n")
    number = add(tmp_path, load_order(str(recipe), "simulated"))
    recipe.write_text("name: other\n")
    entry = queue.load_queue(tmp_path).entries[0]
    order = queue.make_order(entry)
    assert (entry.id, entry.recipe, order.recipe.name) == (number, "mine", "mine")
    assert (order.config, order.target_text) == (ORDER.config, ORDER.target_text)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name: bad\nexperiments: [{warm_upp: {}}]\n", "there is no experiment 'warm_upp'; did you mean warm_up?"),
        ("name: bad\nexperiments: [{thermal_cycle: {set_points_degC: [65]}}]\n", r"outside limits\.chamber_degC"),
    ],
)
def test_a_typo_is_reported_when_a_recipe_is_added_not_when_it_runs(tmp_path: Path, text: str, sentence: str):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(text)
    with pytest.raises(ConfigError, match=sentence):
        load_order(str(recipe), "simulated")


def test_a_file_that_is_no_text_is_named(tmp_path: Path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_bytes(b"name: \xff\xfe")
    with pytest.raises(ConfigError, match=r"recipe\.yaml: cannot be read"):
        load_order(str(recipe), "simulated")


def test_what_this_version_refuses_is_named_with_its_run(tmp_path: Path):
    add(tmp_path)
    entry = queue.load_queue(tmp_path).entries[0].model_copy(update={"recipe_text": "name: x\n"})
    with pytest.raises(ConfigError, match="run 1 of the queue: warm-up: "):
        queue.make_order(entry)


def test_an_interrupted_run_keeps_its_session_and_comes_first(tmp_path: Path):
    add(tmp_path)
    add(tmp_path)
    with lock_worker(tmp_path):
        queue.take(tmp_path, 5)
        queue.note_session(tmp_path, 1, tmp_path / "cycle")
    interrupted, _ = queue.load_queue(tmp_path).entries
    assert (interrupted.state, interrupted.session, interrupted.began_ns) == ("interrupted", "cycle", 5)
    assert interrupted.reason == "its daemon was killed"
    with lock_worker(tmp_path):
        again = queue.take(tmp_path, 9)
        assert again is not None
        assert (again.id, again.session) == (1, "cycle")
        running = queue.load_queue(tmp_path).entries[0]
        assert (running.state, running.began_ns, running.reason) == ("running", 5, "")
        with pytest.raises(SessionError, match="run 1 is running; one"):
            queue.take(tmp_path, 9)
        with pytest.raises(SessionError, match=r"run 1 is running; `stand stop` ends it"):
            queue.remove(tmp_path, 1)
        with pytest.raises(SessionError, match="run 1 is running; only"):
            queue.move(tmp_path, 1, 1)


def test_of_the_runs_that_have_ended_the_latest_are_kept(tmp_path: Path):
    waiting = add(tmp_path)
    ended = tuple(
        queue.load_queue(tmp_path).entries[0].model_copy(update={"id": number, "state": QueueState.DONE})
        for number in range(2, KEPT_ENDED + 20)
    )
    with change_queue(tmp_path) as draft:
        draft.set(entries=(*ended, *draft.queue.entries), next_id=1000)
    assert [number for number, _ in states(tmp_path)] == [each.id for each in ended[-KEPT_ENDED:]] + [waiting]
    assert add(tmp_path) == 1000


def test_a_halted_queue_gives_nothing_until_it_is_cleared(tmp_path: Path):
    add(tmp_path)
    add(tmp_path)
    with lock_worker(tmp_path):
        queue.take(tmp_path, 2)
        queue.finish(tmp_path, 1, QueueState.FAILED, 3, "air is too warm", halt=True)
        with pytest.raises(StandTripped, match=r"halted: run 1: air is too warm"):
            queue.take(tmp_path, 4)
        assert states(tmp_path) == [(1, "failed"), (2, "waiting")]
        queue.reset(tmp_path)
        assert queue.take(tmp_path, 4) is not None


def test_only_one_works_a_queue(tmp_path: Path):
    with (
        lock_worker(tmp_path),
        pytest.raises(SessionError, match="running its queue"),
        lock_worker(tmp_path),
    ):
        pass
    with lock_worker(tmp_path):
        pass


@pytest.mark.parametrize("number", [2, -1])
def test_a_missing_number_is_reported(tmp_path: Path, number: int):
    add(tmp_path)
    with pytest.raises(SessionError, match=f"no run {number} in the queue"):
        queue.remove(tmp_path, number)


ADDING = """
import sys
from pathlib import Path
from thermostand.stand.service import queue
from thermostand.stand.running.order import load_order
order = load_order("warm-up", "simulated")
print("ready", flush=True)
sys.stdin.readline()
for _ in range(20):
    number = queue.append(Path(sys.argv[1]), queue.make_entry(order, "simulated", 1)).id
    queue.move(Path(sys.argv[1]), number, 1)
"""


def test_two_processes_at_once_lose_nothing(tmp_path: Path):
    with contextlib.ExitStack() as stack:
        command = [sys.executable, "-m", "tests.code", ADDING, str(tmp_path)]
        processes = [
            stack.enter_context(fork_server.popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
            for _ in range(2)
        ]
        for process in processes:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
        for process in processes:
            assert process.stdin is not None
            process.stdin.close()
    assert [process.returncode for process in processes] == [0, 0]
    assert sorted(number for number, _ in states(tmp_path)) == list(range(1, 41))


DAMAGES = [
    lambda data: b"",
    lambda data: data[: len(data) // 2],
    lambda data: b"\xff" + data,
    lambda data: data.replace(b'"waiting"', b'"failed" '),  # as a sector of an earlier state has it
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_named_left_alone_and_can_be_put_right(tmp_path: Path, damage):
    add(tmp_path)
    add(tmp_path)
    path = tmp_path / QUEUE_NAME
    damaged = damage(path.read_bytes())
    path.write_bytes(damaged)
    for attempt in (lambda: add(tmp_path), lambda: queue.load_queue(tmp_path), lambda: queue.take(tmp_path, 1)):
        with pytest.raises(SessionError, match=r"queue\.json: is damaged .*queue\.json\.last in the same") as caught:
            attempt()
        assert "\n" not in str(caught.value)
    assert path.read_bytes() == damaged
    (tmp_path / LAST_NAME).rename(path)
    assert states(tmp_path) == [(1, "waiting")]


def test_a_queue_that_is_gone_or_as_it_was_before_its_last_change_is_none_to_go_on_with(tmp_path: Path):
    """A disk may forget the last rename, or a name, though both were synced."""
    for _ in range(3):
        add(tmp_path)
    path, last = tmp_path / QUEUE_NAME, tmp_path / LAST_NAME
    path.write_bytes(last.read_bytes())
    for attempt in (lambda: add(tmp_path), lambda: queue.load_queue(tmp_path)):
        with pytest.raises(SessionError, match=r"lost its last change; .* then remove queue\.json\.last"):
            attempt()
    path.unlink()
    for attempt in (lambda: add(tmp_path), lambda: queue.load_queue(tmp_path)):
        with pytest.raises(SessionError, match=r"is missing; queue\.json\.last in the same folder is .*: rename it"):
            attempt()
    last.rename(path)
    assert states(tmp_path) == [(1, "waiting"), (2, "waiting")]


def test_a_change_that_is_taken_back_is_no_change_that_was_lost(tmp_path: Path):
    add(tmp_path)
    first = (tmp_path / QUEUE_NAME).read_bytes()
    for reason in ("a trip", ""):
        with change_queue(tmp_path) as draft:
            draft.set(halted=reason)
    (tmp_path / LAST_NAME).write_bytes(first)  # the power failed before that of the last change was there
    assert states(tmp_path) == [(1, "waiting")]


def test_a_disk_that_refuses_leaves_the_queue_as_it_was(tmp_path: Path):
    add(tmp_path)
    limit_files(1000)
    try:
        with pytest.raises(SessionError, match=r"\(File too large\)"):
            add(tmp_path)
    finally:
        limit_files()
    assert states(tmp_path) == [(1, "waiting")]
    (tmp_path / LAST_NAME).mkdir()  # in the way of what it was before
    add(tmp_path)
    assert states(tmp_path) == [(1, "waiting"), (2, "waiting")]


def test_looking_at_a_folder_without_a_queue_leaves_nothing_in_it(tmp_path: Path):
    assert states(tmp_path) == []
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SessionError, match="no such folder"):
        queue.remove(tmp_path / "nowhere", 1)
