"""The drift model: where would this point have been at the reference temperature?

The paper's form (section 6.1), one polynomial per coordinate of total degree n in the measured position (I, J) and the
camera's own temperature T, fitted to the displacement (reference minus measured). For n >= 1 the position itself is in
the space, so this is the same fit as that of the reference positions. compensation/drift/fitting.py makes the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from compensation.drift.polynomial import Float, Scaling, design, exponents
from compensation.files import write_whole
from drivers.documents import Document
from drivers.interface import SessionError

FORMAT = "thermostand drift model"
MAX_DEGREE = 5
_HULL_MARGIN_PX = 1.0
"""The markers themselves move by this much over the calibrated temperatures."""

_LEAST_HULL_WIDTH_PX = 5.0
"""Markers in one line, too, span a few px across it when they drift; a second row of them is many px away."""

Pair = tuple[float, float]


class DegreeScore(Document):
    """What leave-temperatures-out says of one degree; a fold is one chamber set-point with all its visits.

    condition: 2-norm condition number of the weighted terms, all folds together. rms_px: held-out RMS along I and J,
    all folds counting the same. fold_chamber_degC, fold_rms_px: the same for each fold.
    """

    degree: Annotated[int, Field(ge=1, le=MAX_DEGREE)]
    terms: int
    condition: float
    rms_px: Pair
    fold_chamber_degC: tuple[float, ...]
    fold_rms_px: tuple[Pair, ...]


@dataclass(frozen=True, slots=True, eq=False)
class CompensationModel:
    """Maps measured positions of one camera to those at the reference temperature.

    degree: n. scaling: image and calibrated temperature range. coefficients (2, K) px and their covariance (2, K, K)
    px^2, rows I and J, terms in the order of polynomial.exponents. discrepancy_px (2,): what the form leaves
    unexplained at temperatures not fitted, one standard deviation, marker noise taken off. hull_px (H, 2): convex hull
    of the training markers. reference_degC: the camera's temperature at the reference, reference_chamber_degC the
    set-point. reference_centres_px (N, 2): of the first session with reference frames, NaN for a marker never seen.
    scores: of every degree tried.
    """

    degree: int
    scaling: Scaling
    coefficients: Float
    coefficient_covariance: Float
    discrepancy_px: Float
    hull_px: Float
    reference_degC: float
    reference_chamber_degC: float
    reference_centres_px: Float
    scores: tuple[DegreeScore, ...]
    target_name: str
    camera_serial: str
    session_ids: tuple[str, ...]
    software_version: str

    def shift(self, xy_px: Float, camera_degC: float | Float) -> Float:
        """Displacement (N, 2), px, to the reference temperature of points (N, 2) measured at camera temperature(s), one
        or (N,). Outside the valid range it extrapolates: ask `inside`. NaN in, NaN out."""
        return self._terms(xy_px, camera_degC) @ self.coefficients.T

    def correct(self, xy_px: Float, camera_degC: float | Float) -> Float:
        """Where the points (N, 2), px, would be at the reference temperature."""
        return xy_px + self.shift(xy_px, camera_degC)

    def covariance(self, xy_px: Float, camera_degC: float | Float) -> Float:
        """Covariance (N, 2, 2), px^2, of `shift`: A (A' W A)^-1 A' + s^2, without the noise of the point itself."""
        terms = self._terms(xy_px, camera_degC)
        variance = np.einsum("nk,ckl,nl->nc", terms, self.coefficient_covariance, terms) + self.discrepancy_px**2
        return variance[:, :, None] * np.eye(2)

    def inside(self, xy_px: Float, camera_degC: float | Float) -> NDArray[np.bool_]:
        """(N,): whether the points and temperatures are in the calibrated range: the hull of the training markers
        (plus 1 px) and the interval of the camera's temperature. NaN is outside."""
        low, high = self.scaling.camera_degC
        temperature = np.broadcast_to(camera_degC, len(xy_px))
        return (
            (_distances_px(xy_px, self.hull_px) >= -_HULL_MARGIN_PX).all(axis=1)
            & (temperature >= low)
            & (temperature <= high)
        )

    @property
    def score(self) -> DegreeScore:
        """The cross-validation of the degree in use."""
        return next(score for score in self.scores if score.degree == self.degree)

    def _terms(self, xy_px: Float, camera_degC: float | Float) -> Float:
        temperature = np.broadcast_to(np.asarray(camera_degC, np.float64), len(xy_px))
        return design(xy_px, temperature, self.degree, self.scaling)

    def save(self, path: Path) -> None:
        """Write the model as JSON, whole or not at all; SessionError when the place refuses."""
        write_whole(path, _document(self).model_dump_json(indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> CompensationModel:
        """The model in a file that `save` wrote, number for number; SessionError when it is anything else."""
        try:
            text = path.read_text(encoding="utf-8")
            return _model(ModelFile.model_validate_json(text, strict=True))
        except (OSError, UnicodeDecodeError) as error:
            raise SessionError(f"{path}: cannot be read ({error})") from error
        except ValidationError as error:
            fault = error.errors()[0]
            where = ".".join(str(part) for part in fault["loc"]) or "the file"
            raise SessionError(f"{path}: not a drift model of this program ({where}: {fault['msg']})") from error
        except ValueError as error:
            raise SessionError(f"{path}: not a drift model of this program ({error})") from error


def is_area(hull_px: Float) -> bool:
    """Whether the corners (H, 2) are those of a convex polygon, in the sense that turns x towards y, and not so thin
    that it may be a line."""
    sides = np.linalg.norm(np.roll(hull_px, -1, axis=0) - hull_px, axis=1)
    if len(hull_px) < 3 or sides.min() == 0:
        return False
    distances = _distances_px(hull_px, hull_px)
    return bool(distances.min() > -_HULL_MARGIN_PX and distances.max(axis=0).min() > _LEAST_HULL_WIDTH_PX)


def _distances_px(xy_px: Float, hull_px: Float) -> Float:
    """How far points (N, 2) are inside each side of the hull (H, 2), shape (N, H); negative is outside."""
    sides = np.roll(hull_px, -1, axis=0) - hull_px
    along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    offset = xy_px[:, None] - hull_px
    return along[:, 0] * offset[:, :, 1] - along[:, 1] * offset[:, :, 0]


class ModelFile(Document):
    """A model as JSON; every number with its unit, arrays as nested lists, a marker never seen as null."""

    format: Literal["thermostand drift model"] = FORMAT
    schema_version: Literal[1] = 1
    software_version: str
    camera_serial: str
    session_ids: tuple[str, ...]
    target_name: str
    degree: Annotated[int, Field(ge=1, le=MAX_DEGREE)]
    image_size_px: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    camera_range_degC: Pair
    reference_degC: float
    reference_chamber_degC: float
    terms_abc: tuple[tuple[int, int, int], ...]
    coefficients_px: tuple[tuple[float, ...], tuple[float, ...]]
    coefficient_covariance_px2: tuple[tuple[tuple[float, ...], ...], tuple[tuple[float, ...], ...]]
    discrepancy_px: Pair
    hull_px: Annotated[tuple[Pair, ...], Field(min_length=3)]
    reference_centres_px: tuple[Pair | None, ...]
    scores: tuple[DegreeScore, ...]


def _document(model: CompensationModel) -> ModelFile:
    return ModelFile.model_validate(
        {
            "software_version": model.software_version,
            "camera_serial": model.camera_serial,
            "session_ids": model.session_ids,
            "target_name": model.target_name,
            "degree": model.degree,
            "image_size_px": model.scaling.image_size,
            "camera_range_degC": model.scaling.camera_degC,
            "reference_degC": model.reference_degC,
            "reference_chamber_degC": model.reference_chamber_degC,
            "terms_abc": exponents(model.degree),
            "coefficients_px": model.coefficients.tolist(),
            "coefficient_covariance_px2": model.coefficient_covariance.tolist(),
            "discrepancy_px": model.discrepancy_px.tolist(),
            "hull_px": model.hull_px.tolist(),
            "reference_centres_px": [None if math.isnan(x) else (x, y) for x, y in model.reference_centres_px.tolist()],
            "scores": model.scores,
        }
    )


def _model(file: ModelFile) -> CompensationModel:
    """The model of a file; ValueError when its parts do not fit together."""
    count = len(exponents(file.degree))
    if list(file.terms_abc) != exponents(file.degree):
        raise ValueError(f"terms_abc: not the {count} terms of degree {file.degree}, in order")
    if not file.camera_range_degC[0] < file.camera_range_degC[1]:
        raise ValueError("camera_range_degC: not low, high")
    if file.degree not in {score.degree for score in file.scores}:
        raise ValueError(f"scores: none for degree {file.degree}")
    if not is_area(np.array(file.hull_px)):
        raise ValueError("hull_px: not the corners of a convex area, in order")
    return CompensationModel(
        degree=file.degree,
        scaling=Scaling(file.image_size_px, file.camera_range_degC),
        coefficients=_shaped("coefficients_px", file.coefficients_px, (2, count)),
        coefficient_covariance=_shaped(
            "coefficient_covariance_px2", file.coefficient_covariance_px2, (2, count, count)
        ),
        discrepancy_px=np.array(file.discrepancy_px),
        hull_px=np.array(file.hull_px),
        reference_degC=file.reference_degC,
        reference_chamber_degC=file.reference_chamber_degC,
        reference_centres_px=np.array([centre or (math.nan, math.nan) for centre in file.reference_centres_px]),
        scores=file.scores,
        target_name=file.target_name,
        camera_serial=file.camera_serial,
        session_ids=file.session_ids,
        software_version=file.software_version,
    )


def _shaped(name: str, values: object, shape: tuple[int, ...]) -> Float:
    try:
        array = np.array(values, np.float64)
    except ValueError as error:
        raise ValueError(f"{name}: rows of different lengths") from error
    if array.shape != shape:
        raise ValueError(f"{name}: shape {array.shape} instead of {shape}")
    return array
