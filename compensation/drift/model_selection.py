"""The one call that makes a drift model: the paper's form or the thermal one, or whichever predicts better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, TypeVar

import numpy as np

from thermostand.compensation.drift.bumps import correct_bumps, find_bumps
from thermostand.compensation.drift.candidates import NEGLIGIBLE_PX, Candidate, compute_moving_rms_px
from thermostand.compensation.drift.displacements import compute_displacements
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.model_facts import Bump
from thermostand.compensation.drift.paper_model import PaperModel, check_degree, compute_left_out_residuals, fit_paper
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.training_data import build_training
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import ConfigError, SessionError

Form = Literal["paper", "thermal"]
FORMS: tuple[Form, ...] = ("paper", "thermal")
Fitted = TypeVar("Fitted")
Say = Callable[[str], None]


def fit(
    observations: Observations, degree: int | None = None, form: Form | None = None, say: Say = lambda sentence: None
) -> DriftModel:
    """Fit the drift model to these sessions.

    Parameters
    ----------
    observations : Observations
        The frames of one camera and target.
    degree : int, optional
        Degree of the paper's form, which it implies. By default cross-validation chooses it.
    form : "paper" or "thermal", optional
        By default the form that better predicts what was left out is taken: temperatures between others and, where
        these were recorded, frames on the way and after switching on. The paper's is taken when both predict equally
        well. Sessions that support only one form get that one.
    say : callable
        Gets the sentence that says why the sessions do not support the form that was not taken.

    Returns
    -------
    DriftModel
        Its `other` is the form that was not taken, where the sessions support it.

    Raises
    ------
    SessionError
        When the sessions cannot support what was asked for, or a degree was given for the thermal form.

    Notes
    -----
    The model is fitted around steps that no thermal state explains (`facts.bumps`): frames on the other side of a step
    count as if the camera had not been moved, and are as uncertain as the step is.
    """
    check_request(degree, form)
    bumps = find_bumps(observations)
    return _attach_bumps(bumps, _fit_forms(correct_bumps(observations, bumps), degree, form, say))


def _attach_bumps(bumps: tuple[Bump, ...], model: DriftModel) -> DriftModel:
    """The model, and its other form, with the bumps that it was fitted around."""
    other = None if model.other is None else _attach_bumps(bumps, model.other)
    return replace(model, facts=replace(model.facts, bumps=bumps), other=other)


def _fit_forms(observations: Observations, degree: int | None, form: Form | None, say: Say) -> DriftModel:
    asked = form if degree is None else "paper"
    paper = _try_fit(lambda: fit_paper(observations, degree))
    thermal = _try_fit(lambda: _fit_thermal(observations))
    if asked is None and isinstance(paper, PaperModel) and isinstance(thermal, ThermalModel):
        return select_better(_score_transient_frames(observations, paper, thermal), thermal)
    is_thermal = asked == "thermal" or (asked is None and isinstance(thermal, ThermalModel))
    used, name, other = (thermal, "paper", paper) if is_thermal else (paper, "thermal", thermal)
    if isinstance(used, SessionError):
        raise used
    if not isinstance(other, SessionError):
        return replace(used, other=other)
    if asked is None:
        say(f"the {name} form could not be fitted: {other}")
    return used


def _try_fit(fitted: Callable[[], Fitted]) -> Fitted | SessionError:
    try:
        return fitted()
    except SessionError as error:
        return error


def _fit_thermal(observations: Observations) -> ThermalModel:
    if not any(history.has_ambient for history in observations.histories):
        raise SessionError("the sessions have no history of the air near the camera; the thermal form needs it")
    return fit_thermal(observations)


def check_request(degree: int | None, form: Form | None) -> None:
    """ConfigError when there is no such degree, or a degree is asked for of the thermal form."""
    check_degree(degree)
    if degree is not None and form == "thermal":
        raise ConfigError("the thermal form has no degree; leave out --degree, or ask for --form paper")


def _score_transient_frames(observations: Observations, paper: PaperModel, thermal: ThermalModel) -> PaperModel:
    """The paper's form with what it leaves of frames that were not at rest, the same as of the thermal form."""
    asked = build_training(observations, thermal.terms, thermal.memory).moving_rows
    rows = compute_displacements(observations, observations.of(Role.REFERENCE, Role.FIT))
    found = compute_moving_rms_px(compute_left_out_residuals(rows, paper.degree, paper.scaling, asked))
    scored = tuple(one.model_copy(update={"moving_rms_px": found if one.chosen else None}) for one in paper.candidates)
    return replace(paper, candidates=scored)


def select_better(paper: PaperModel, thermal: ThermalModel) -> DriftModel:
    """Choose the model with the smaller squares at what was left out; each gets the table with the rows of both."""
    both = paper.candidates + thermal.candidates
    in_use = [next(one for one in model.candidates if one.chosen) for model in (paper, thermal)]
    of_paper, of_thermal = in_use
    has_same_folds = of_paper.fold_chamber_degC == of_thermal.fold_chamber_degC
    is_thermal = has_same_folds and _is_better_predictor(of_paper, of_thermal)
    form = "thermal" if is_thermal else "paper"
    rows = tuple(one.model_copy(update={"chosen": one.chosen and one.form == form}) for one in both)
    if is_thermal:
        return replace(thermal, candidates=rows, other=paper)
    return replace(paper, candidates=rows, other=thermal)


def _is_better_predictor(paper: Candidate, thermal: Candidate) -> bool:
    """Return whether the thermal form predicts better than the paper's by more than anybody measures, at set-points
    between others, and as much on the way and after switching on, where frames of these were recorded: who records them
    will ask about them. That the paper's form needs no history does not weigh against its prediction: it is in the file
    in any case, and `apply` takes it where there is none."""
    squares = [[float(one.squares_between.mean())] for one in (paper, thermal)]
    if paper.moving_rms_px is not None and thermal.moving_rms_px is not None:
        # At rest the paper's form was chosen for 2 of 24 drawn cameras by 0.1 mpx, where it left 33 and 74 mpx after
        # switching on and the thermal form 2 and 3.
        for of_form, one in zip(squares, (paper.moving_rms_px, thermal.moving_rms_px), strict=True):
            of_form.append(one[0] ** 2 + one[1] ** 2)
    rms_px = [float(np.sqrt(np.mean(of_form))) for of_form in squares]
    return rms_px[1] < rms_px[0] - NEGLIGIBLE_PX
