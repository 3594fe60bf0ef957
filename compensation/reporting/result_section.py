"""The result first: what compensation gained, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Iterator

from thermostand.compensation.drift.evaluation import improvement_percent
from thermostand.compensation.drift.unrepeated import Cause
from thermostand.compensation.reporting.numbers import Numbers, Pair, ScoreNumbers, percent
from thermostand.compensation.reporting.page import Heading, Paragraph, Part, Table
from thermostand.compensation.reporting.validation_report import gains_table
from thermostand.compensation.validation3d.validate import Validation

PAPER = (
    "Paper: Adamczyk et al., Temperature Compensation Method for Digital Cameras in 2D and 3D Measurement "
    "Applications, Sensors 2018, 18, 3685: section 3.1 (warm-up), 6.2 (polynomial of degree 4), 7 (in space)."
)
_LEAST_COVERAGE = 0.9


def result_section(numbers: Numbers, validation: Validation | None = None) -> Iterator[Part]:
    """The table and what to know of it; without a model, that there is none."""
    yield Heading("Result")
    if numbers.score is None:
        yield Paragraph(
            "These sessions have no frames over a thermal cycle that a model could be fitted to, which needs the roles "
            "reference and fit: this report shows the drift alone."
        )
    else:
        yield from _gain(numbers, numbers.score)
    yield from _bumps(numbers)
    yield from _unrepeated(numbers)
    if validation is not None:
        yield Paragraph(
            "In space, the mean absolute deviation of the target from its place at the reference temperature:"
        )
        yield gains_table(validation, ours(numbers))
    yield Paragraph(PAPER, aside=True)


def _bumps(numbers: Numbers) -> Iterator[Part]:
    if not numbers.bumps:
        return
    several = f"{len(numbers.bumps)} times the image" if len(numbers.bumps) > 1 else "Once the image"
    around = (
        "" if numbers.model is None else " The model was fitted around this; its figures are as if it had not been."
    )
    yield Paragraph(
        f"{several} moved in a step that no temperature explains: something was touched, or a fixing slipped.{around}"
    )
    rows = [(one.session_id, _clock(one.after), _clock(one.before), one.text) for one in numbers.bumps]
    yield Table(("session", "after, UTC", "before, UTC", "what moved"), rows)


def _unrepeated(numbers: Numbers) -> Iterator[Part]:
    for one in numbers.unrepeated:
        if one.cause != Cause.NOTHING:
            yield Paragraph(f"Session {one.session_id}: {one.text}. No model of temperature can follow that.")


def _clock(instant: str) -> str:
    return instant[:19].replace("T", " ")


def ours(numbers: Numbers) -> str:
    """What this report's row is called in a table beside the paper's."""
    return "this report (simulated)" if numbers.simulated else "this report"


def _gain(numbers: Numbers, score: ScoreNumbers) -> Iterator[Part]:
    heads = ("RMS deviation, px", "I before", "I after", "gain", "J before", "J after", "gain")
    paper = (numbers.paper["before_px"], numbers.paper["after_px"])
    rows = [
        ("paper (measured)", *_gains(*paper)),
        (ours(numbers), *_gains(score.before_px, score.after_px)),
    ]
    yield Table(heads, rows, chosen=1)
    i, j = (percent(100 * part, 0) for part in score.coverage_95)
    note = (
        f"{score.frames} frames; {score.method}. The deviation is the distance of a marker centre from its place at "
        f"the reference temperature. Of the deviations after compensation, {i} (I) and {j} (J) "
        "lie in the 95 % interval that the model claims."
    )
    if min(score.coverage_95) < _LEAST_COVERAGE:
        note += (
            " That is too few: at the held-out temperatures the camera did something that the fitted frames do not "
            "show. Most often its drift depends on the way there (thermal lag, hysteresis) and not on its temperature "
            "alone."
        )
    if score.outside:
        note += f" {percent(100 * score.outside)} of the centres are outside the model's valid range."
    yield Paragraph(note)


def _gains(before: Pair, after: Pair) -> Iterator[str]:
    for b, a in zip(before, after, strict=True):
        yield from (f"{b:z.3f}", f"{a:z.3f}" if a >= 0.01 else f"{a:z.4f}", percent(improvement_percent(b, a)))
