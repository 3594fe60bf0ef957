"""A virtual run and its simulator share one CPU, and give the others back."""

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from stand.simulator import one_cpu

CPUS = "import os; print(sorted(os.sched_getaffinity(0)))"


def test_what_is_started_inside_shares_the_cpu_and_afterwards_all_are_usable_again():
    usable = os.sched_getaffinity(0)
    of_thread: list[set[int]] = []
    with one_cpu():
        (cpu,) = os.sched_getaffinity(0)
        assert cpu in usable
        assert subprocess.run([sys.executable, "-c", CPUS], capture_output=True, text=True).stdout == f"[{cpu}]\n"
        thread = threading.Thread(target=lambda: of_thread.append(os.sched_getaffinity(0)))
        thread.start()
        thread.join()
    assert of_thread == [{cpu}]
    assert os.sched_getaffinity(0) == usable


def test_a_thread_that_was_there_before_and_one_that_stays_behind_follow():
    usable = os.sched_getaffinity(0)
    with ThreadPoolExecutor(1) as before, ThreadPoolExecutor(1) as within:
        assert before.submit(os.sched_getaffinity, 0).result() == usable
        with one_cpu():
            assert len(before.submit(os.sched_getaffinity, 0).result()) == 1
            assert len(within.submit(os.sched_getaffinity, 0).result()) == 1
        assert before.submit(os.sched_getaffinity, 0).result() == usable
        assert within.submit(os.sched_getaffinity, 0).result() == usable


def test_the_cpus_are_given_back_also_after_an_error():
    usable = os.sched_getaffinity(0)
    with pytest.raises(ValueError, match="half-way"), one_cpu():
        raise ValueError("half-way")
    assert os.sched_getaffinity(0) == usable
