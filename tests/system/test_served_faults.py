"""Faults of a served stand that has a run, over real wires and signals: two at once."""

import fcntl
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.recording.disks import ext4, run
from tests.system.conftest import FAST
from tests.system.test_daemon import LIMIT_S, Served, is_idle
from tests.system.test_unrecorded_heat import SOAK
from thermostand.foundation.errors import SessionError
from thermostand.recording.writing.disk import MODULE
from thermostand.stand.running.opening.writer_restarts import MOST_PER_H
from thermostand.stand.running.order import Order
from thermostand.stand.serving.api_models import StandState

LEAVES_WITHIN_S = 8.0  # 5 s on an idle machine; the waits take 3.6 s (tests/stand/test_leaving.py)
STOPPED_S = 1.5  # 6 periods of the guard


@pytest.fixture
def served(tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]) -> Iterator[Served]:
    with ext4(tmp_path / "disk", 6 << 30) as disk:
        ordered = order(SOAK, **FAST)
        simulator(ordered.config, False)
        served = Served(tmp_path / "config.yaml", disk / "out")
        try:
            yield served
        finally:
            subprocess.run(["fsfreeze", "-u", disk], check=False, capture_output=True)
            served.process.kill()
            served.process.communicate()


def disk_processes(served: Served) -> list[int]:
    """The daemon's own, which was started first, and that of the record between runs."""
    tasks = Path(f"/proc/{served.process.pid}/task").iterdir()
    children = {int(pid) for task in tasks for pid in (task / "children").read_text().split()}
    return sorted(pid for pid in children if MODULE in Path(f"/proc/{pid}/cmdline").read_text().split("\0"))


@pytest.fixture
def begin(tmp_path: Path, laboratory: Path) -> Iterator[Callable[[], Served]]:
    """Start daemons of this laboratory; whatever is left of them ends with the test."""
    begun: list[Served] = []

    def start() -> Served:
        begun.append(Served(laboratory, tmp_path / "out"))
        return begun[-1]

    yield start
    for each in begun:
        each.process.kill()
        each.process.communicate()


@pytest.mark.usefixtures("own_helpers")
def test_whichever_disk_process_is_killed_no_heat_goes_on_without_what_it_did(begin: Callable[[], Served]):
    """That of the record between runs is replaced, and an operator may reset and heat again. Without its own the daemon
    knows neither its queue nor keeps the compressor's rest: it ends, and the next one has both."""
    served = begin()
    served.until(is_idle)
    served.post("devices/regulator/set", arguments={"setpoint_degC": 40.0})
    served.until(lambda state: state.readings["relays.heater_enable"].value == 1)
    _, of_record = disk_processes(served)
    os.kill(of_record, signal.SIGKILL)
    served.until(lambda state: state.fault is not None and state.readings["relays.heater_enable"].value == 0)
    served.until(lambda _: len(set(disk_processes(served)) - {of_record}) == 2)
    served.until(lambda state: state.disk_free_bytes > 0)  # there is a record again
    served.post("run/reset")
    assert served.state().fault is None
    served.post("devices/regulator/set", arguments={"setpoint_degC": 40.0})
    served.until(lambda state: state.readings["relays.heater_enable"].value == 1)
    os.kill(disk_processes(served)[0], signal.SIGKILL)
    assert served.process.wait(LIMIT_S) == 1
    assert "(killed by SIGKILL)" in served.reported()
    assert begin().until(is_idle).readings["relays.heater_enable"].value == 0


@contextmanager
def locked(path: Path) -> Generator[None]:
    path.parent.mkdir(exist_ok=True)
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def suppressed(work: Callable[[], object]) -> None:
    with suppress(SessionError):
        work()


def test_a_hung_disk_holds_the_stand_over_a_stop_of_the_process_and_keeps_nobody_from_leaving(served: Served):
    """While somebody asks for the queue and the sessions, and writes notes, which lie on that disk. Before that another
    program has locked the queue when the daemon is started."""
    with locked(served.out / ".queue.lock"):
        served.until(is_idle)
    served.submit(SOAK)
    heating = served.until(lambda state: state.readings["relays.heater_enable"].value == 1)
    assert heating.run is not None
    session = Path(heating.run.session).name
    run("fsfreeze", "-f", served.out.parent)

    def is_held(state: StandState) -> bool:
        return state.fault is not None and state.fault.rule == "not_recorded"

    held = served.until(is_held)
    assert held.fault is not None
    assert held.fault.data["ends_itself"]
    served.until(lambda state: state.readings["relays.heater_enable"].value == 0)
    os.kill(served.process.pid, signal.SIGSTOP)
    time.sleep(STOPPED_S)  # noqa: TID251 - a process that is stopped for real
    os.kill(served.process.pid, signal.SIGCONT)
    assert is_held(served.state())
    for work in (
        lambda: served.server.request("GET", "/api/v1/sessions"),
        lambda: served.submit(SOAK),
        lambda: served.post(f"sessions/{session}/notes", text="the disk is hung"),
    ):
        threading.Thread(target=suppressed, args=(work,), daemon=True).start()
    assert is_held(served.state())
    served.process.send_signal(signal.SIGTERM)
    began_s = time.monotonic()
    served.process.wait(LEAVES_WITHIN_S)
    assert time.monotonic() - began_s < LEAVES_WITHIN_S
    assert served.process.returncode == 0
    reported = served.reported()
    assert "Traceback" not in reported
    assert "held no longer" not in reported  # the disk still hangs
    assert "recording ended" in reported
    assert "queue does not know" in reported


@pytest.mark.usefixtures("own_helpers")
def test_a_served_run_whose_disk_process_is_killed_is_resumed_by_itself_and_by_an_operator(served: Served):
    """By itself three times in an hour; then it is an operator's, who resets and resumes: what was written is repaired
    first, though no segment of it was ever finished."""
    served.until(is_idle)
    served.submit(SOAK)

    def is_heating(state: StandState) -> bool:
        return state.run is not None and state.readings["relays.heater_enable"].value == 1

    for again in range(MOST_PER_H + 1):
        served.until(is_heating)
        os.kill(disk_processes(served)[-1], signal.SIGKILL)
        served.until(lambda state: state.readings["relays.heater_enable"].value == 0)
        if again < MOST_PER_H:
            served.until(lambda state: state.run is not None and state.fault is None)
    ended = served.until(lambda state: state.phase == "idle" and [run.state for run in state.queue] == ["failed"])
    assert ended.fault is not None
    served.post("run/reset")
    served.post(f"sessions/{ended.queue[0].session}/resume")
    served.until(is_heating)
    served.post("run/stop")
    served.until(lambda state: state.run is None)
