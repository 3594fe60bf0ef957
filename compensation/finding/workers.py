"""Pieces worked on here, in processes of this machine, or on a Dask cluster; the results are the same to the bit."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from tempfile import TemporaryDirectory, mkstemp
from typing import Any

import cv2

from thermostand.compensation.finding.piece import FoundMarkers, Piece, find_markers
from thermostand.foundation.errors import ConfigError, SessionError

Work = Callable[[Sequence[Piece]], Iterator[tuple[int, FoundMarkers]]]
"""Pieces -> (index, its markers), each piece once, in any order."""

_TRIES = 3
"""A piece whose worker died so often has killed it: the machine is out of memory, or the file is poison."""


def find_in_turn(pieces: Sequence[Piece]) -> Iterator[tuple[int, FoundMarkers]]:
    """One piece after the other, in this process."""
    for index, piece in enumerate(pieces):
        yield index, find_markers(piece)


def make_process_work(workers: int) -> Work:
    """Start so many processes, each with one thread. What a process that was killed had not finished is done again by
    another; SessionError when that does not help.

    The process that they are forked from loads what they need from now on, while this one makes the pieces."""
    # Started afresh, each process would load numba, SciPy and OpenCV again: 1 s of processor time.
    multiprocessing.set_forkserver_preload([find_markers.__module__])
    ensure_running()

    def work(pieces: Sequence[Piece]) -> Iterator[tuple[int, FoundMarkers]]:
        left, tries = set(range(len(pieces))), 0
        while left:
            before = len(left)
            with TemporaryDirectory(prefix="thermostand-found-") as folder, open_pool(workers) as processes:
                try:
                    for index, found in _iterate_finished(processes, folder, pieces, sorted(left)):
                        left.discard(index)
                        yield index, found
                except BrokenProcessPool as error:
                    tries = 1 if len(left) < before else tries + 1
                    if tries >= _TRIES:
                        raise SessionError(
                            f"{pieces[min(left)].segment}: the processes that look for its markers are killed each "
                            "time; is there enough memory? Try fewer --workers"
                        ) from error

    return work


def _iterate_finished(
    processes: ProcessPoolExecutor, folder: str, pieces: Sequence[Piece], indices: Iterable[int]
) -> Iterator[tuple[int, FoundMarkers]]:
    """Iterate over results as they are finished, also those that were when the pool broke."""
    waiting: dict[Future[str], int] = {
        processes.submit(find_to_file, pieces[index], folder): index for index in indices
    }
    broken: BrokenProcessPool | None = None
    while waiting:
        done, _ = wait(waiting, return_when=FIRST_COMPLETED)
        for future in done:
            index = waiting.pop(future)
            try:
                path = Path(future.result())
            except BrokenProcessPool as error:
                broken = error
            else:
                found: FoundMarkers = pickle.loads(path.read_bytes())
                path.unlink()
                yield index, found
    if broken is not None:
        raise broken


def find_to_file(piece: Piece, folder: str) -> str:
    """The path of a file with the piece's markers. A pool's processes answer on one pipe: of one that is killed in the
    middle of a long answer the pool would wait for the rest for ever; an answer below PIPE_BUF is written whole."""
    number, path = mkstemp(dir=folder)
    with open(number, "wb") as file:
        pickle.dump(find_markers(piece), file)
    return path


@contextmanager
def open_pool(workers: int) -> Generator[ProcessPoolExecutor]:
    """Forked from a process of their own kind that has loaded what they need, once for all pools (a fork of this one
    would copy its threads' locks); what is not begun is dropped on any early way out."""
    context = multiprocessing.get_context("forkserver")
    processes = ProcessPoolExecutor(workers, mp_context=context, initializer=_initialise_worker)
    try:
        yield processes
    finally:
        processes.shutdown(wait=True, cancel_futures=True)


def _initialise_worker() -> None:
    """One thread, and no longer than the process that gives the work: nobody is notified when the owner of a pool was
    killed."""
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_owner, daemon=True).start()


def _end_with_owner() -> None:
    owner = multiprocessing.parent_process()
    if owner is not None:
        owner.join()
        os._exit(1)


def make_cluster_work(address: str, wait_s: float = 10.0) -> Work:
    """The Dask cluster whose scheduler is at `address` (host:port); its workers must see the sessions' files under the
    same paths. ConfigError when Dask is missing or does not answer there."""

    def work(pieces: Sequence[Piece]) -> Iterator[tuple[int, FoundMarkers]]:
        with _connect(address, wait_s) as client:
            futures = [client.submit(find_markers, piece, pure=False, retries=_TRIES) for piece in pieces]
            index_of = {future.key: index for index, future in enumerate(futures)}
            for future, found in _iterate_completed(futures, client.loop):
                yield index_of[future.key], found

    return work


def _connect(address: str, wait_s: float) -> Any:
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError("--cluster needs Dask: pip install 'thermostand[cluster]'") from error
    try:
        return Client(address, timeout=wait_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--cluster {address}: no Dask scheduler answers there ({error})") from error


def _iterate_completed(futures: Any, loop: Any) -> Any:
    from distributed import as_completed

    return as_completed(futures, loop=loop, with_results=True)
