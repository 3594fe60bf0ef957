"""A virtual run and its simulator on one CPU, which no other virtual run of this machine has taken."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress

_CPU_FOLDER = "/sys/devices/system/cpu/cpu{}"


@contextmanager
def one_cpu() -> Generator[None]:
    """Inside, this process and its children (the simulator) run on one of the CPUs they may use.

    In virtual time daemon and simulator take turns, a dozen in each polled second, and never work at once. On one CPU a
    turn is a switch of context; on two it is waking an idle CPU, which takes longer than the answer. Runs side by side
    take different CPUs as long as there are any left.
    """
    usable = os.sched_getaffinity(0)
    cpu, folder = _take(sorted(usable))
    _use({cpu})
    try:
        yield
    finally:
        _use(usable)
        if folder is not None:
            os.close(folder)


def _take(cpus: Sequence[int]) -> tuple[int, int | None]:
    """The first of `cpus` that no other run has taken, and the descriptor that keeps it; when there is none, one by the
    process' number.

    It is taken by a lock on the kernel's own folder for that CPU: no file is left anywhere, and the lock ends with the
    process however that ends.
    """
    for cpu in cpus:
        try:
            folder = os.open(_CPU_FOLDER.format(cpu), os.O_RDONLY)
        except OSError:  # a system without these folders
            continue
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # taken
            os.close(folder)
        else:
            return cpu, folder
    return cpus[os.getpid() % len(cpus)], None


def _use(cpus: set[int]) -> None:
    """Every thread of this process: one that waits for work in a pool would start the simulator elsewhere."""
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread), cpus)
