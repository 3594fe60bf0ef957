"""The compensation: fit, what is left, which form was chosen and why, and how uncertain it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from matplotlib.figure import Figure

from thermostand.compensation.drift.candidates import Candidate
from thermostand.compensation.drift.evaluation import Evaluation
from thermostand.compensation.observations import Observations
from thermostand.compensation.reporting.drawing import fit_figures as figures
from thermostand.compensation.reporting.drawing.path_figures import EXAGGERATION
from thermostand.compensation.reporting.numbers import (
    FormulaNumbers,
    ModelNumbers,
    Numbers,
    ScoreNumbers,
    compact,
    percent,
    typeset,
)
from thermostand.compensation.reporting.page import Drawing, Facts, Heading, Listing, Paragraph, Part, Table

_FORMS = {
    "paper": "displacement to the reference = P(I, J, T), one polynomial per coordinate; T is the camera's temperature",
    "thermal": "displacement to the reference = the motions of a homography, each linear in the camera's thermal state",
}
_MOST_THERMAL = 10
_WIDE = 0.98
_COMMON = "homography x (1, T, T^2), "
"""Of every thermal form, said once."""


def compensation_section(observations: Observations, evaluation: Evaluation, score: ScoreNumbers) -> Iterator[Part]:
    """Before and after."""
    method = score.method
    yield Heading("Before and after compensation")
    yield Drawing(
        figures.compensated_paths(observations, evaluation),
        "compensated",
        f"Drift of each marker, enlarged {EXAGGERATION} times, before and after compensation; {method}.",
    )
    yield Drawing(
        figures.residual_map(observations, evaluation),
        "residual-map",
        "What the model leaves at each marker, measured − model, mean over the frames of each set-point, at a scale of "
        f"its own; arrows that agree over the image are errors of the model, not noise; {method}.",
    )
    of_evaluation: tuple[tuple[str, Callable[[Evaluation], Figure], str], ...] = (
        (
            "fit",
            figures.measured_against_model,
            "Measured drift of each marker centre against the drift the model says; on the line both are the same",
        ),
        (
            "residuals",
            figures.residuals,
            "What the model leaves of each centre; grey is the 95 % interval that model and markers claim together",
        ),
        (
            "histogram",
            figures.histogram,
            "Deviations of marker centres from their reference, before compensation and, on a scale of its own, after",
        ),
        ("temperature", figures.against_temperature, "RMS deviation at each chamber temperature"),
    )
    for name, draw, caption in of_evaluation:
        yield Drawing(draw(evaluation), name, f"{caption}; {method}.")
    yield Table(
        ("chamber, °C", "camera, °C", "frames", "I before, px", "I after, mpx", "J before, px", "J after, mpx"),
        [
            (
                f"{row.chamber_degC:g}",
                f"{row.camera_degC:z.2f}",
                str(row.frames),
                f"{row.before_px[0]:z.3f}",
                f"{1e3 * row.after_px[0]:z.1f}",
                f"{row.before_px[1]:z.3f}",
                f"{1e3 * row.after_px[1]:z.1f}",
            )
            for row in score.temperatures
        ],
    )


def model_section(model: ModelNumbers) -> Iterator[Part]:
    """The form in use, where it holds, and what else was tried."""
    low, high = model.camera_range_degC
    columns, rows = zip(*model.hull_px, strict=True)
    yield Heading("Model")
    yield Facts(
        [
            ("Form", f"{model.form}: {_FORMS[model.form]}"),
            ("In use", typeset(model.title)),
            ("Reference", f"camera {model.reference_degC:z.2f} °C, chamber {model.reference_chamber_degC:g} °C"),
            (
                "Valid for",
                f"camera {low:z.2f} to {high:z.2f} °C; I {min(columns):z.0f} to {max(columns):z.0f} px, "
                f"J {min(rows):z.0f} to {max(rows):z.0f} px",
            ),
            ("Fitted to", ", ".join(model.session_ids)),
            ("Fitted by", f"thermostand {model.software_version}"),
        ]
    )
    yield from _formula(model.formula)
    yield Paragraph(
        "Leave-temperatures-out: each chamber set-point with all its visits is predicted from the others. In use is "
        "the simplest of each form within one standard error of the best, or the one asked for; the thermal form takes "
        "the paper's place when it is better by more than one standard error. Every thermal form is a homography times "
        "1, T, T² (T: the camera's temperature) and what is listed.",
        aside=True,
    )
    yield from _candidates(model)
    yield Paragraph(_why(model))


def _formula(formula: FormulaNumbers) -> Iterator[Part]:
    """Written out, with every coefficient and its standard uncertainty."""
    yield Listing("\n".join(formula.lines))
    pairs = zip(formula.terms, formula.coefficients_px, formula.sigma_px, strict=True)
    rows = [
        (name, *(compact(value, u) for value, u in zip(values.tolist(), sigmas.tolist(), strict=True)))
        for name, values, sigmas in pairs
    ]
    heads = ("coefficient of", *formula.heads)
    if formula.reference:
        heads = ("coefficient of f", "r", *formula.heads)
        at = (typeset(f"{value:z.4f}") for value in formula.reference)
        rows = [(name, value, *rest) for (name, *rest), value in zip(rows, at, strict=True)]
    yield Table(heads, rows)
    yield Paragraph(
        "In brackets: the standard uncertainty of the last digits, by the fit. The coefficients are correlated "
        "with each other, and rounded here: to compute with them take all digits, from the file beside this page or "
        "the model.",
        aside=True,
    )


def _candidates(model: ModelNumbers) -> Iterator[Part]:
    """All of the paper's form, and the best of the others; the one in use is bold."""
    paper = [one for one in model.candidates if one.form == "paper"]
    others = [one for one in model.candidates if one.form != "paper"]
    others.sort(key=lambda one: (not one.chosen, float(one.fold_squares.mean())))
    rows = [*paper, *others[:_MOST_THERMAL]]
    chosen = next((index for index, one in enumerate(rows) if one.chosen), None)
    heads = ("candidate", "coefficients", "held-out RMS I, mpx", "J")
    yield Table(heads, [_candidate(one) for one in rows], chosen=chosen)
    if len(others) > _MOST_THERMAL:
        yield Paragraph(f"{len(others) - _MOST_THERMAL} more are in the file beside this page.", aside=True)


def _why(model: ModelNumbers) -> str:
    """The best of each form that was tried, one beside the other."""
    best = [
        min(tried, key=lambda one: float(one.fold_squares.mean()))
        for form in _FORMS
        if (tried := [one for one in model.candidates if one.form == form])
    ]
    listed = " and ".join(
        f"{one.rms_px[0] * 1e3:z.1f} / {one.rms_px[1] * 1e3:z.1f} mpx (I / J) for the {one.form} form" for one in best
    )
    return f"At temperatures left out, the best leave {listed}. In use is the {model.form} form."


def _candidate(one: Candidate) -> tuple[str, ...]:
    name = f"{one.form}: {typeset(one.name.removeprefix(_COMMON))}"
    rms = (f"{1e3 * value:z.1f}" for value in one.rms_px)
    return (name, str(one.terms), *rms)


def uncertainty_section(numbers: Numbers) -> Iterator[Part]:
    """Of a compensated centre, and whether the claim held."""
    model, score = numbers.model, numbers.score
    if model is None or score is None:
        return
    yield Heading("Uncertainty")
    yield Table(
        ("standard uncertainty, mpx", "I", "J"),
        [
            ("measured deviation of a centre (markers)", *_mpx(score.marker_sigma_px)),
            ("unexplained by the form at temperatures left out", *_mpx(model.discrepancy_px)),
            *_another_night(model),
            ("compensated centre, as claimed", *_mpx(score.claimed_sigma_px)),
            ("compensated centre, as found (RMS)", *_mpx(score.after_px)),
            ("part within the claimed 95 % interval", *(percent(100 * part) for part in score.coverage_95)),
        ],
    )
    if score.coverage_95[0] > _WIDE and score.coverage_95[1] > _WIDE:
        yield Paragraph(
            f"More than the claimed 95 % are within: at these {len(score.temperatures)} temperatures the interval is "
            "wider than it had to be. It stands for other nights and other ways to a temperature too, which these do "
            "not show."
        )
    if model.nights_compared == 0 and (model.between_nights_px is not None or len(model.session_ids) == 1):
        yield Paragraph(_one_night(model))


def _one_night(model: ModelNumbers) -> str:
    """What is known of other nights where none were compared."""
    added = (
        "is not known, and not in the uncertainty"
        if model.between_nights_px is None
        else "was assumed, not measured, from cameras of published numbers"
    )
    return (
        f"How well nights repeat {added}: a dead zone in a mount, or a thermometer far from the camera, may leave 20 "
        "mpx and more on another night. A second night over the same set-points, in another order and fitted with this "
        "one, measures it."
    )


def _another_night(model: ModelNumbers) -> Iterator[tuple[str, ...]]:
    if model.between_nights_px is not None:
        known = f"of {model.nights_compared} compared" if model.nights_compared else "assumed"
        yield f"added by a night that was not fitted, {known}", *_mpx(model.between_nights_px)


def _mpx(values_px: tuple[float, float]) -> Iterator[str]:
    return (f"{1e3 * value:z.2f}" for value in values_px)
