"""A virtual run and its simulator share one CPU, and give the others back."""

import multiprocessing
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from thermostand.stand.service import run
from thermostand.stand.service.run import pin_to_one_cpu

CPUS = "import os; print(sorted(os.sched_getaffinity(0)))"


def test_what_is_started_inside_shares_the_cpu_and_afterwards_all_are_usable_again():
    usable = os.sched_getaffinity(0)
    of_thread: list[set[int]] = []
    with pin_to_one_cpu():
        (cpu,) = os.sched_getaffinity(0)
        assert cpu in usable
        assert subprocess.run([sys.executable, "-c", CPUS], capture_output=True, text=True).stdout == f"[{cpu}]\n"
        thread = threading.Thread(target=lambda: of_thread.append(os.sched_getaffinity(0)))
        thread.start()
        thread.join()
    assert of_thread == [{cpu}]
    assert os.sched_getaffinity(0) == usable


def test_an_earlier_thread_and_one_that_stays_behind_follow():
    usable = os.sched_getaffinity(0)
    with ThreadPoolExecutor(1) as before, ThreadPoolExecutor(1) as within:
        assert before.submit(os.sched_getaffinity, 0).result() == usable
        with pin_to_one_cpu():
            assert len(before.submit(os.sched_getaffinity, 0).result()) == 1
            assert len(within.submit(os.sched_getaffinity, 0).result()) == 1
        assert before.submit(os.sched_getaffinity, 0).result() == usable
        assert within.submit(os.sched_getaffinity, 0).result() == usable


def test_the_cpus_are_given_back_also_after_an_error():
    usable = os.sched_getaffinity(0)
    with pytest.raises(ValueError, match="half-way"), pin_to_one_cpu():
        raise ValueError("half-way")
    assert os.sched_getaffinity(0) == usable


def hold(folder: Path, sender: Connection) -> None:
    run._CPU_FOLDER = str(folder / "cpu{}")  # type: ignore[reportPrivateUsage]  # others may take the machine's now
    with pin_to_one_cpu():
        sender.send(os.sched_getaffinity(0))
        threading.Event().wait()


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="there is one CPU only")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # of threads that have ended
def test_runs_side_by_side_take_different_cpus_and_a_killed_one_gives_its_own_back(tmp_path: Path):
    """Whatever the numbers of their processes: as many at once as there are CPUs, and as many again."""
    usable = os.sched_getaffinity(0)
    for cpu in usable:
        (tmp_path / f"cpu{cpu}").mkdir()
    fork = multiprocessing.get_context("fork")
    for _ in range(2):
        heard, sender = fork.Pipe(duplex=False)
        runs = [fork.Process(target=hold, args=(tmp_path, sender)) for _ in usable]
        for each in runs:
            each.start()
        taken = set[int]().union(*(heard.recv() for _ in usable))
        for each in runs:
            each.kill()
            each.join()
        assert len(taken) == len(usable)


def test_the_kernel_has_the_folders_by_which_cpus_are_taken():
    assert all(Path(f"/sys/devices/system/cpu/cpu{cpu}").is_dir() for cpu in os.sched_getaffinity(0))
