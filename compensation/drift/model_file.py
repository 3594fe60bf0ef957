"""Drift models as JSON files: every number with its unit, arrays as nested lists, a marker never seen as null.

A file holds the form in use and, as `other`, the one that was not chosen. From 0.2.0 on formats are kept: each
version of the program reads the files of all before it. Those of versions before 10 are of unreleased versions and are
not read.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, TypeAdapter

from thermostand.compensation.drift.candidates import Candidate, Pair
from thermostand.compensation.drift.claims import BetweenSessions, Claims, Question
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.hull import is_area
from thermostand.compensation.drift.model_facts import Bump, ModelFacts
from thermostand.compensation.drift.paper_model import MAX_DEGREE, DegreeScore, PaperModel, list_exponents
from thermostand.compensation.drift.terms import MOTIONS, Term, parse_term
from thermostand.compensation.drift.thermal_model import ThermalModel, ThermalRange
from thermostand.compensation.drift_runtime import HOTTEST_degC
from thermostand.compensation.value_checks import (
    Degrees,
    Hull,
    NotNegative,
    Size,
    check_covariance,
    check_order,
    check_shape,
    check_terms,
    check_within_image,
)
from thermostand.foundation.documents import Document, load_json
from thermostand.foundation.files import write_atomically

FORMAT = "thermostand drift model"
SCHEMA_VERSION = 10

_FACTS = (
    *("software_version", "camera_serial", "session_ids", "target_name", "camera_range_degC", "reference_degC"),
    *("reference_chamber_degC", "bumps"),
)
"""Fields of ModelFacts that a file has as they are."""
Spread = tuple[NotNegative, NotNegative]
Range = tuple[Degrees, Degrees]
Rows = tuple[tuple[float, ...], ...]


def _check_version(version: int) -> int:
    if version < SCHEMA_VERSION:
        raise ValueError(f"{version} is of an earlier, unreleased version of thermostand; fit the model again")
    if version > SCHEMA_VERSION:
        raise ValueError(f"{version} is of a later version; this one reads up to {SCHEMA_VERSION}")
    return version


class _File(Document):
    """What the files of all forms have."""

    format: Literal["thermostand drift model"] = FORMAT
    schema_version: Annotated[int, AfterValidator(_check_version)] = SCHEMA_VERSION
    software_version: str
    camera_serial: str
    session_ids: tuple[str, ...]
    target_name: str
    image_size_px: Size
    camera_range_degC: Range
    reference_degC: Degrees
    reference_chamber_degC: Degrees
    reference_centres_px: tuple[Pair | None, ...]
    hull_px: Hull
    discrepancy_px: Spread
    candidates: tuple[Candidate, ...]
    bumps: tuple[Bump, ...] = ()


class PaperFile(_File):
    """The paper's form."""

    form: Literal["paper"] = "paper"
    degree: Annotated[int, Field(ge=1, le=MAX_DEGREE)]
    terms_abc: tuple[tuple[int, int, int], ...]
    coefficients_px: tuple[tuple[float, ...], tuple[float, ...]]
    coefficient_covariance_px2: tuple[Rows, Rows]
    scores: tuple[DegreeScore, ...]
    other: ThermalFile | None = None


def _serialise_term(term: Term) -> dict[str, object]:
    """Return a term's kind and parameters, as terms.term_of takes them."""
    return {"kind": term.kind, **term.model_dump()}


_Term = Annotated[Term, BeforeValidator(parse_term), PlainSerializer(_serialise_term)]


class ThermalFile(_File):
    """The thermal form. coefficient_covariance_px2 (8 H, H): of each motion one below the other. least_on_s: null when
    the camera was never switched on within the record. between_sessions_px: one standard deviation of what a session
    that was not fitted adds, null where that is not known; with sessions_compared 0 it was assumed, not measured.
    claim_factors: what the covariance is multiplied by in a session that was fitted, in another one, of a camera in its
    first hour with and without a warm-up that was fitted, and beyond the calibrated temperatures; claim_least_px: the
    least uncertainty, along I and J. prior_px (8, H): standard deviations of the coefficients before anything was
    seen."""

    form: Literal["thermal"] = "thermal"
    terms: tuple[_Term, ...]
    reference_ambient_degC: Degrees
    reference_features: tuple[float, ...]
    self_heating_K: Annotated[float, Field(gt=0, le=HOTTEST_degC)]
    has_warm_up: bool
    coefficients_px: Rows
    coefficient_covariance_px2: Rows
    ambient_range_degC: Range
    least_on_s: NotNegative | None
    leverage_matrix_px2: Rows
    leverage_px2: Annotated[float, Field(gt=0)]
    history_s: NotNegative
    between_sessions_px: Spread | None
    sessions_compared: Annotated[int, Field(ge=0)]
    claim_factors: Annotated[tuple[NotNegative, ...], Field(min_length=len(Question), max_length=len(Question))]
    claim_least_px: Spread
    prior_px: Rows | None = None
    other: PaperFile | None = None


_ANY: TypeAdapter[PaperFile | ThermalFile] = TypeAdapter(
    Annotated[PaperFile | ThermalFile, Field(discriminator="form")]
)


def save_model(model: DriftModel, path: Path | str) -> None:
    """Write the model as JSON, whole or not at all.

    Parameters
    ----------
    model
        What `fit` gave.
    path
        The file; one that exists is replaced.

    Raises
    ------
    SessionError
        When the place refuses.
    """
    write_atomically(Path(path), _build_document(model).model_dump_json(indent=1) + "\n")


def load_model(path: Path | str) -> DriftModel:
    """Load the model from a file that `save_model` wrote, number for number.

    Parameters
    ----------
    path
        The JSON file.

    Returns
    -------
    DriftModel
        The model.

    Raises
    ------
    SessionError
        When it is anything else, or of another version.
    """
    return load_json(path, lambda text: _build_model(_ANY.validate_json(text, strict=True)), "a drift model")


def _build_model(file: PaperFile | ThermalFile) -> DriftModel:
    """Build a model and its other form; ValueError when its parts, or the two, do not fit together."""
    model = _build_paper_model(file) if isinstance(file, PaperFile) else _build_thermal_model(file)
    if file.other is None:
        return model
    other = _build_model(file.other)
    if other.other is not None:
        raise ValueError("other: has another form itself")
    for name in ("camera_serial", "session_ids", "target_name", "image_size"):
        if getattr(other.facts, name) != getattr(model.facts, name):
            raise ValueError(f"other: its {name} is {getattr(other.facts, name)}, not {getattr(model.facts, name)}")
    return replace(model, other=other)


def _build_document(model: DriftModel) -> PaperFile | ThermalFile:
    facts = model.facts
    common = {
        **{name: getattr(facts, name) for name in _FACTS},
        "image_size_px": facts.image_size,
        "reference_centres_px": [None if math.isnan(x) else (x, y) for x, y in facts.reference_centres_px.tolist()],
        "hull_px": facts.hull_px.tolist(),
        "discrepancy_px": model.discrepancy_px.tolist(),
        "candidates": model.candidates,
        "other": None if model.other is None else _build_document(model.other),
    }
    match model:
        case PaperModel():
            return PaperFile.model_validate({**common, **_list_paper_fields(model)})
        case ThermalModel():
            return ThermalFile.model_validate({**common, **_list_thermal_fields(model)})
        case _:
            raise TypeError(f"no file form for a model of form {model.form}")


def _list_paper_fields(model: PaperModel) -> dict[str, object]:
    return {
        "degree": model.degree,
        "terms_abc": list_exponents(model.degree),
        "coefficients_px": model.coefficients.tolist(),
        "coefficient_covariance_px2": model.coefficient_covariance.tolist(),
        "scores": model.scores,
    }


def _list_thermal_fields(model: ThermalModel) -> dict[str, object]:
    return {
        "terms": model.terms,
        "reference_ambient_degC": model.reference_ambient_degC,
        "reference_features": model.reference_features.tolist(),
        "self_heating_K": model.self_heating_K,
        "has_warm_up": model.has_warm_up,
        "coefficients_px": model.coefficients.tolist(),
        "coefficient_covariance_px2": np.concatenate(model.coefficient_covariance).tolist(),
        "leverage_matrix_px2": model.leverage_matrix.tolist(),
        "ambient_range_degC": model.valid.ambient_degC,
        "least_on_s": None if math.isinf(model.valid.least_on_s) else model.valid.least_on_s,
        "leverage_px2": model.valid.leverage,
        "history_s": model.history_s,
        "between_sessions_px": None if model.between_sessions is None else model.between_sessions.sigma_px,
        "sessions_compared": 0 if model.between_sessions is None else model.between_sessions.sessions,
        "claim_factors": model.claims.factors,
        "claim_least_px": model.claims.least_px,
        "prior_px": None if model.prior_px is None else model.prior_px.tolist(),
    }


def _build_paper_model(file: PaperFile) -> PaperModel:
    """The model of a file; ValueError when its parts do not fit together."""
    count = len(list_exponents(file.degree))
    if list(file.terms_abc) != list_exponents(file.degree):
        raise ValueError(f"terms_abc: not the {count} terms of degree {file.degree}, in order")
    if file.degree not in {score.degree for score in file.scores}:
        raise ValueError(f"scores: none for degree {file.degree}")
    coefficients = check_shape("coefficients_px", file.coefficients_px, (2, count))
    covariance = check_shape("coefficient_covariance_px2", file.coefficient_covariance_px2, (2, count, count))
    check_terms("coefficients_px", np.abs(coefficients).sum(axis=1), file.image_size_px)
    check_covariance("coefficient_covariance_px2", covariance)
    model = PaperModel(
        facts=_build_facts(file),
        degree=file.degree,
        coefficients=coefficients,
        coefficient_covariance=covariance,
        discrepancy_px=np.array(file.discrepancy_px),
        scores=file.scores,
        candidates=file.candidates,
    )
    moved_px = [model.shift(model.facts.hull_px, degC) for degC in file.camera_range_degC]
    check_within_image("coefficients_px", moved_px, file.image_size_px)
    return model


def _build_thermal_model(file: ThermalFile) -> ThermalModel:
    """The model of a file; ValueError when its parts do not fit together."""
    count = len(file.terms)
    rows = check_shape("coefficient_covariance_px2", file.coefficient_covariance_px2, (MOTIONS * count, count))
    covariance = rows.reshape(MOTIONS, count, count)
    leverage_matrix = check_shape("leverage_matrix_px2", file.leverage_matrix_px2, (count, count))
    reference_features = check_shape("reference_features", file.reference_features, (count,))
    coefficients = check_shape("coefficients_px", file.coefficients_px, (MOTIONS, count))
    # Features are about 1 at 20 K from the reference, motions at the image's edge.
    check_terms("coefficients_px", np.abs(coefficients).sum(axis=1), file.image_size_px)
    check_within_image("reference_features", coefficients @ reference_features, file.image_size_px)
    check_covariance("coefficient_covariance_px2", covariance)
    check_covariance("leverage_matrix_px2", leverage_matrix)
    check_order("ambient_range_degC", file.ambient_range_degC)
    return ThermalModel(
        facts=_build_facts(file),
        terms=file.terms,
        reference_ambient_degC=file.reference_ambient_degC,
        self_heating_K=file.self_heating_K,
        reference_features=reference_features,
        coefficients=coefficients,
        coefficient_covariance=covariance,
        leverage_matrix=leverage_matrix,
        discrepancy_px=np.array(file.discrepancy_px),
        valid=ThermalRange(
            ambient_degC=file.ambient_range_degC,
            least_on_s=math.inf if file.least_on_s is None else file.least_on_s,
            leverage=file.leverage_px2,
            history_s=file.history_s,
        ),
        has_warm_up=file.has_warm_up,
        candidates=file.candidates,
        between_sessions=None
        if file.between_sessions_px is None
        else BetweenSessions(file.between_sessions_px, file.sessions_compared),
        claims=Claims(file.claim_factors, file.claim_least_px),
        prior_px=None if file.prior_px is None else check_shape("prior_px", file.prior_px, (MOTIONS, count)),
    )


def _build_facts(file: PaperFile | ThermalFile) -> ModelFacts:
    if not file.camera_range_degC[0] < file.camera_range_degC[1]:
        raise ValueError("camera_range_degC: not low, high")
    hull_px = np.array(file.hull_px)
    if not is_area(hull_px):
        raise ValueError("hull_px: not the corners of a convex area, in order")
    return ModelFacts(
        **{name: getattr(file, name) for name in _FACTS},
        image_size=file.image_size_px,
        hull_px=hull_px,
        reference_centres_px=np.array([centre or (math.nan, math.nan) for centre in file.reference_centres_px]),
    )
