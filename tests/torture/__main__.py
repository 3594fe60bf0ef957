"""`python -m tests.torture [SEED | --seeds A..B | --minutes N | --case FILE] [--jobs N]`: see docs/how-to."""

from __future__ import annotations

import argparse
import itertools
import math
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from functools import partial
from pathlib import Path

from tests import fork_server
from tests.torture.case import draw, read_case, write_case
from tests.torture.coverage import Reached
from tests.torture.real import draw_real
from tests.torture.rig import Result, format_result, perform, perform_seed, shrink


def say(text: str) -> None:
    """At once, though it goes to a file."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main() -> int:
    """1 when an invariant was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.torture", description="Drawn stands, faults and orders.")
    parser.add_argument("seed", nargs="?", type=int, help="one seed, whose case is printed")
    parser.add_argument("--seeds", help="A..B, both included")
    parser.add_argument("--minutes", type=float, help="seeds that begin with the time now, for so long")
    parser.add_argument("--real", action="store_true", help="in real time, with processes, disk and doors broken, too")
    parser.add_argument("--case", type=Path, help="a YAML as it is printed for a seed, or by shrinking")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="the folder in which the files of one seed or case stay")
    parser.add_argument(
        "--shrink", type=int, default=0, metavar="TRIES", help="of a broken case, by at most so many runs"
    )
    given = parser.parse_args()
    forks = fork_server.Forks()
    try:
        results, left = _results(given)
        return _report(results, left, given)
    finally:
        forks.close()


def _results(given: argparse.Namespace) -> tuple[Iterator[Result], Callable[[int, float], float]]:
    """They as they come, and how long it still takes, s, of how many are there after how many s."""
    if given.case or given.seed is not None:
        case = read_case(given.case) if given.case else (draw_real if given.real else draw)(given.seed)
        say(write_case(case))
        return (perform(each, given.keep) for each in (case,)), lambda count, spent_s: 0.0
    if given.minutes:
        end_s, begun_s = 60.0 * given.minutes, time.monotonic()
        seeds = itertools.count(int(time.time()))  # noqa: TID251 - of the host
        return _performed(seeds, begun_s + end_s, given), lambda count, spent_s: max(0.0, end_s - spent_s)
    first, _, last = (given.seeds or "1..12").partition("..")
    seeds = range(int(first), int(last or first) + 1)
    return _performed(seeds, math.inf, given), lambda count, spent_s: (len(seeds) - count) * spent_s / count


def _performed(seeds: Iterable[int], end_s: float, given: argparse.Namespace) -> Iterator[Result]:
    """As they end; none is begun any more at end_s."""
    perform_one = partial(perform_seed, is_real=given.real)
    jobs, context, left, under_way = (
        given.jobs,
        multiprocessing.get_context("spawn"),
        iter(seeds),
        set[Future[Result]](),
    )
    with ProcessPoolExecutor(jobs, context, fork_server.be_served, (fork_server.served_at(),)) as pool:
        while True:
            while len(under_way) < jobs and time.monotonic() < end_s and (seed := next(left, None)) is not None:
                under_way.add(pool.submit(perform_one, seed))
            if not under_way:
                return
            done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            yield from (each.result() for each in done)


def _report(results: Iterator[Result], left: Callable[[int, float], float], given: argparse.Namespace) -> int:
    count, broken, simulated_s, begun_s, reached = 0, 0, 0.0, time.monotonic(), Reached(is_real=given.real)
    for result in results:
        count, simulated_s, broken = count + 1, simulated_s + result.simulated_s, broken + bool(result.violations)
        reached.add(result)
        minutes_left = left(count, time.monotonic() - begun_s) / 60.0
        first, *more = format_result(result)
        say("\n".join([f"{first}    [{count} cases, {minutes_left:.0f} min left]", *more]))
        if result.violations and given.shrink:
            least = write_case(shrink(result.case, result.broken, given.shrink))
            (path := Path(tempfile.gettempdir()) / f"torture-{result.case.seed}.yaml").write_text(least)
            say(f"python -m tests.torture --case {path}    what is left of it:\n{least}")
    minutes = (time.monotonic() - begun_s) / 60.0
    say(f"{count} cases, {broken} broken; {simulated_s / 3600.0:.1f} simulated hours in {minutes:.1f} min")
    say("\n".join(reached.format_lines()))
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())
