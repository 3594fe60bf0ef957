"""The pages beside the report: of a datasheet, also as JSON, of a calibration and of a validation."""

from __future__ import annotations

import importlib.metadata
import json
import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import groupby

from thermostand.compensation.calibration.calibrate import CameraCalibration
from thermostand.compensation.calibration.camera_file import CameraFile
from thermostand.compensation.datasheet.datasheet import Datasheet
from thermostand.compensation.datasheet.quantity import COVERAGE, MeasuredQuantity
from thermostand.compensation.reporting.drawing import calibration_figures, datasheet_figures
from thermostand.compensation.reporting.drawing.validation_figures import bars, by_position
from thermostand.compensation.reporting.equipment import Line, stated
from thermostand.compensation.reporting.page import NamedFigure, page
from thermostand.compensation.validation3d.validate import SpatialValidation

FORMAT = "thermostand datasheet 1"
_LIBRARIES = ("thermostand", "numpy", "scipy", "opencv-python-headless")


def datasheet_page(sheet: Datasheet, equipment: Sequence[Line] = ()) -> str:
    """As HTML text; the same data give the same text."""
    unknown: dict[str, list[str]] = {}
    for one in sheet.quantities:
        if one.why:
            unknown.setdefault(one.why, []).append(one.name)
    return page(
        "datasheet",
        f"Thermal datasheet of camera {sheet.model.facts.camera_serial}",
        _datasheet_figures(sheet),
        sheet=sheet,
        span=[_utc(ns) for ns in _span_ns(sheet)],
        groups=[(name, [*members]) for name, members in groupby(sheet.quantities, key=lambda one: one.group)],
        unknown=unknown,
        measured_with=[*stated(sheet.details, sheet.observations.target), *equipment],
        versions=", ".join(f"{name} {version}" for name, version in _versions().items()),
    )


def _datasheet_figures(sheet: Datasheet) -> Iterator[NamedFigure]:
    yield "temperature", datasheet_figures.over_temperature(sheet)
    if sheet.warming is not None:
        yield "warm-up", datasheet_figures.warm_up(sheet.warming, sheet.by_key["settling_s"].value)


def datasheet_json(sheet: Datasheet, equipment: Sequence[Line] = ()) -> str:
    """Every number of the page; what could not be measured is null, and `why` says so."""
    facts = sheet.model.facts
    document = {
        "format": FORMAT,
        "camera": facts.camera_serial,
        "simulated": sheet.observations.simulated,
        "sessions": [one.session_id for one in sheet.observations.sessions],
        "recorded": [_utc(one) for one in _span_ns(sheet)],
        "coverage_factor": COVERAGE,
        "air_degC": sheet.air_degC,
        "camera_degC": sheet.camera_degC,
        "model": {"form": sheet.model.form, "title": sheet.model.title},
        "equipment": dict(equipment),
        "stated": sheet.details.model_dump(exclude_defaults=True),
        "versions": _versions(),
        "quantities": [_plain(one) for one in sheet.quantities],
        "nights": [[_plain(one) for one in night] for night in sheet.nights] if len(sheet.nights) > 1 else [],
    }
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _plain(one: MeasuredQuantity) -> dict[str, object]:
    return {
        "key": one.key,
        "name": one.name,
        "unit": one.unit,
        "value": _finite(one.value),
        "standard_uncertainty": _finite(one.u),
        "expanded_uncertainty": _finite(one.expanded),
        "model": one.model,
        "why": one.why,
        "contributions": [
            {
                "source": line.source,
                "type": line.kind,
                "u": line.u,
                "unit": line.unit,
                "sensitivity": line.sensitivity,
                "amount": line.amount,
                "basis": line.basis,
            }
            for line in one.contributions
        ],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _span_ns(sheet: Datasheet) -> tuple[int, int]:
    observed = sheet.observations
    utc = [observed.sessions[index].utc for index in (observed.session[0], observed.session[-1])]
    return utc[0].utc_ns(int(observed.time_ns[0])), utc[1].utc_ns(int(observed.time_ns[-1]))


def _utc(ns: int) -> str:
    return f"{datetime.fromtimestamp(ns // 1_000_000_000, UTC):%Y-%m-%d %H:%M} UTC"


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in _LIBRARIES}


def calibration_page(file: CameraFile, calibration: CameraCalibration) -> str:
    """As HTML text; the same data give the same text."""
    drawn = {
        "residuals": calibration_figures.residual_vectors,
        "sizes": calibration_figures.residual_sizes,
        "histogram": calibration_figures.normalised_histogram,
        "uncertainty": calibration_figures.uncertainty_map,
        **({"scores": calibration_figures.model_scores} if calibration.scores else {}),
        "rays": calibration_figures.rays_against_pinhole,
        "corrections": calibration_figures.corrections,
    }
    figures = ((name, draw(calibration)) for name, draw in drawn.items())
    return page("calibration", f"Calibration of camera {file.camera_serial}", figures, file=file)


def validation_page(validation: SpatialValidation) -> str:
    """As HTML text; the same validation gives the same text."""
    title = f"Validation of {validation.session_id} in three dimensions"
    return page("validation", title, validation_figures(validation), validation=validation)


def validation_figures(validation: SpatialValidation) -> Iterator[NamedFigure]:
    """Of that page, and of a report's part."""
    yield "bars", bars(validation)
    for number, one in enumerate(variant for variant in (validation.after, validation.with_stand) if variant):
        yield f"positions-{number}", by_position(validation, one)
