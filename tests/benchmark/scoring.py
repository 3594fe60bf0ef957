"""What a method of compensation is, and how it is scored.

A method is a function that learns from one session and returns another one that corrects:

    def fit(training: Observations) -> Corrector
    Corrector = Callable[[Observations, frames (K,), seen_px (K, N, 2)], Correction]

The corrector has the recorded temperatures of the session that is asked about (`histories`, `camera_degC`, `air_degC`),
and never the centres of the frames that are.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.observations import Observations

from .benchmark_cases import GROUPS, TASKS, TRAININGS, Case

Float = NDArray[np.float64]
_SIGMA_95 = 1.959964


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Where what is seen would be at the reference, (K, N, 2) px; where the method knows them, one standard deviation
    of it, and (K, N) which answers it stands by: the others are extrapolations."""

    corrected_px: Float
    sigma_px: Float | None = None
    inside: NDArray[np.bool_] | None = None


Corrector = Callable[[Observations, NDArray[np.int64], Float], Correction]
Method = Callable[[Observations], Corrector]


@dataclass(frozen=True, slots=True)
class Score:
    """One method with one camera and task. rms_mpx: of both coordinates. inside: share of the answers that the method
    stands by. covered: of these, the share in the 95 % interval, NaN where there is none."""

    method: str
    group: str
    learned_from: str
    task: str
    rms_mpx: float
    inside: float
    covered: float
    fit_s: float


def score_method(name: str, method: Method, case: Case) -> list[Score]:
    """Of all tasks of a camera."""
    begin_s = time.perf_counter()
    corrector = method(case.training)
    fit_s = time.perf_counter() - begin_s
    found: list[Score] = []
    for question in case.questions:
        answer = corrector(question.session, question.frames, question.seen_px)
        left = answer.corrected_px - question.reference_px
        inside = np.ones(left.shape[:2], bool) if answer.inside is None else answer.inside
        covered = math.nan
        if answer.sigma_px is not None and inside.any():
            covered = float((np.abs(left) <= _SIGMA_95 * answer.sigma_px)[inside].mean())
        rms_mpx = 1e3 * float(np.sqrt(np.mean(left**2)))
        found.append(
            Score(name, case.group, case.learned_from, question.task, rms_mpx, float(inside.mean()), covered, fit_s)
        )
    return found


def format_table(found: Sequence[Score], methods: Mapping[str, Method]) -> str:
    """A Markdown table for each training and group: median and worst camera of each task, mpx, and the share of the
    answers that the method stands by where it says so; how often its intervals hold there, over all tasks; time to
    fit."""
    blocks: list[str] = []
    for learned_from, group in product(TRAININGS, GROUPS):
        own = [score for score in found if (score.learned_from, score.group) == (learned_from, group)]
        if not own:
            continue
        cameras = sum(score.task == TASKS[0] for score in own) // len(methods)
        heads = ["method", *(f"{task}, mpx" for task in TASKS), "95 % intervals hold", "fit"]
        lines = [
            f"Learned from {learned_from}; {cameras} cameras, {group}:",
            "",
            _format_row(heads),
            _format_row(["---"] * len(heads)),
        ]
        lines += [
            _format_row([name, *_format_cells([score for score in own if score.method == name])]) for name in methods
        ]
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks) + "\n"


def _format_cells(own: Sequence[Score]) -> list[str]:
    cells: list[str] = []
    for task in TASKS:
        here = [score for score in own if score.task == task]
        values = [score.rms_mpx for score in here]
        stands_by = float(np.mean([score.inside for score in here]))
        share = "" if stands_by == 1 else f"; {100 * stands_by:.0f} % inside"
        cells.append(f"{np.median(values):.1f}, worst {max(values):.1f}{share}")
    covered = [(score.covered, score.inside) for score in own if not math.isnan(score.covered)]
    values, weights = zip(*covered, strict=True) if covered else ((), ())
    cells.append(f"{100 * float(np.average(values, weights=weights)):.1f} %" if covered else "none given")
    cells.append(f"{np.median([score.fit_s for score in own]):.1f} s")
    return cells


def _format_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
