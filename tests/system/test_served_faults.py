"""Faults of a served stand that has a run, over real wires and signals: two at once."""

import fcntl
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from foundation.errors import SessionError
from stand.running.order import Order
from stand.serving.desk import StandState
from tests.recording.disks import ext4, run
from tests.system.conftest import FAST, require_aravis
from tests.system.test_daemon import Served, is_idle
from tests.system.test_unrecorded_heat import SOAK

LEAVES_WITHIN_S = 8.0  # 5 s on an idle machine; the waits take 3.6 s (tests/stand/test_leaving.py)
STOPPED_S = 1.5  # 6 periods of the guard


@pytest.fixture
def served(tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]) -> Iterator[Served]:
    require_aravis()
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


@contextmanager
def locked(path: Path) -> Iterator[None]:
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
    told = served.told()
    assert "Traceback" not in told
    assert "the stand is held no longer" not in told  # the disk still hangs
    assert "the recording ended while the disk held it up" in told
    assert "the queue does not know it yet" in told
