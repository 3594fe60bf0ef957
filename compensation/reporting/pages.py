"""The pages besides the report: of a datasheet, also as JSON, of a calibration and of a validation."""

from __future__ import annotations

# What a template gives to a filter has no type.
# pyright: reportUnknownLambdaType=false
import importlib
import importlib.metadata
import json
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from itertools import groupby
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from thermostand.compensation.calibration.calibrate import CameraCalibration
from thermostand.compensation.calibration.camera_file import CameraFile
from thermostand.compensation.certificate.certificate import Certificate, Conformity
from thermostand.compensation.datasheet.datasheet import COVERAGE, Datasheet, MeasuredQuantity
from thermostand.compensation.drift.bumps import list_sessions_at_limit
from thermostand.compensation.drift.drift_model import Outside
from thermostand.compensation.drift.evaluation import compute_improvement_percent
from thermostand.compensation.reporting.drawing import page_figures
from thermostand.compensation.reporting.drawing.figures import Draw, render_in_turn
from thermostand.compensation.reporting.equipment import Line, list_stated_details
from thermostand.compensation.reporting.report_numbers import (
    format_compact,
    format_percent,
    format_significant,
    format_with_expanded_uncertainty,
    typeset,
)
from thermostand.compensation.validation3d import document
from thermostand.compensation.validation3d.document import describe_flags, format_with_limit, list_reason_names
from thermostand.compensation.validation3d.validate import SpatialValidation
from thermostand.foundation.errors import ConfigError

# Pages by templates: one HTML file that needs no other. What a page says is in its template, how it looks in ui.jinja;
# every text is escaped. Numbers and figures are given to it.

NamedFigure = tuple[str, Figure]
"""The name begins its ids, so that several fit in one page."""
_ROLLED_DEG = 1.0  # round number, not measured; only words of the page hang on it


def render_page(
    template: str, title: str, figures: Iterable[NamedFigure] = (), draw: Draw = render_in_turn, **values: object
) -> str:
    """The page of a template as HTML text: of `values`, and `svg`, the figures by their names."""
    named = list(figures)
    svg = dict(zip((name for name, _ in named), draw([(figure, name) for name, figure in named]), strict=True))
    return _make_environment().get_template(f"{template}.html.jinja").render(title=title, svg=svg, **values)


@cache
def _make_environment() -> Environment:
    made = Environment(
        loader=PackageLoader("thermostand.compensation", "reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters.update(_FILTERS)
    names: dict[str, Any] = {
        "paper": document,
        "flagged": describe_flags,
        "reasons": _list_reasons,
        "sessions_at_limit": list_sessions_at_limit,
    }
    made.globals.update(names)
    return made


def format_mpx(value_px: float, digits: int = 1) -> str:
    """A dash for what is not known."""
    return "–" if math.isnan(value_px) else f"{1e3 * value_px:z.{digits}f}"


def format_utc(instant: str) -> str:
    """ISO 8601 to what is read on a page; of nothing, that it is not known."""
    if not instant:
        return "at unknown times"
    return f"{instant[:16].replace('T', ' ')} UTC"


def format_orientation(roll_deg: float) -> str:
    """Say how a camera is turned against the first one."""
    if math.isnan(roll_deg):
        return "camera"
    return "normal camera" if abs(roll_deg) < _ROLLED_DEG else f"camera rotated by {abs(roll_deg):z.1f}°"


def _format_each(values: Iterable[float], spec: str, over: float = 1.0) -> list[str]:
    return [format(value / over, spec) if math.isfinite(value) else "-" for value in values]


def _format_counts(found: Mapping[str, int], before: str = "", after: str = "") -> str:
    return ", ".join(f"{count} {name.replace(before, after) if before else name}" for name, count in found.items())


def _list_reasons(validation: SpatialValidation) -> list[str]:
    return list_reason_names(Outside(int(np.bitwise_or.reduce(validation.flags, axis=None))))


_FILTERS: dict[str, Any] = {
    "to": format,
    "known": lambda value, spec: format(value, spec) if math.isfinite(value) else "",
    "is_finite": math.isfinite,
    "fine": lambda value, limit, digits: f"{value:z.{digits + (value < limit)}f}",
    "gain": lambda before, after, digits=1: format_percent(compute_improvement_percent(before, after), digits),
    "mpx": format_mpx,
    "in_mm": lambda pair, mm_per_px: format_significant(math.hypot(*pair) * mm_per_px, 2),
    "percent": format_percent,
    "measured": lambda value, expanded: [*format_with_expanded_uncertainty(value, expanded)],
    "significant": format_significant,
    "typeset": typeset,
    "compacts": lambda values, sigmas: [
        format_compact(*each) for each in zip(values.tolist(), sigmas.tolist(), strict=True)
    ],
    "utc": format_utc,
    "orientation": format_orientation,
    "counts": _format_counts,
    "each": _format_each,
    "times": lambda values, factor: [factor * value for value in values],
    "limits": lambda values, sigmas: [format_with_limit(*each) for each in zip(values, sigmas, strict=True)],
    "rms": lambda values: np.sqrt(np.nanmean(values**2, axis=0)),
    "mean": lambda values, axis=(0, 1): np.nanmean(values, axis=axis),
}


def render_pdf(html: str) -> bytes:
    """A page as a PDF, by WeasyPrint: print rules of the page's own style sheet, no browser, no network. ConfigError
    when it, or the text library it draws with, is not installed."""
    try:
        weasyprint: Any = importlib.import_module("weasyprint")
    except (ImportError, OSError) as error:
        raise ConfigError(
            f"a PDF needs WeasyPrint and Pango ({error}): pip install 'thermostand[pdf]', and on Debian "
            "apt install libpango-1.0-0 libpangoft2-1.0-0; or write .html and print it"
        ) from error
    # It reads figures' styles twice, once as if they were HTML's, and warns of each property.
    logging.getLogger("weasyprint").setLevel(logging.ERROR)
    # Nothing outside of the page is looked up: it has everything in it.
    return bytes(weasyprint.HTML(string=html, url_fetcher=_fetch_data_url).write_pdf())


def _fetch_data_url(url: str, *_: object, **__: object) -> Any:
    if url.startswith("data:"):
        fetch: Any = importlib.import_module("weasyprint.urls").default_url_fetcher
        return fetch(url)
    raise ValueError(f"{url[:80]}: a page refers to nothing outside of itself")


FORMAT = "thermostand datasheet 1"
_LIBRARIES = ("thermostand", "numpy", "scipy", "opencv-python-headless")


def render_datasheet_page(sheet: Datasheet, equipment: Sequence[Line] = ()) -> str:
    """Render the datasheet as HTML text; the same data give the same text."""
    unknown: dict[str, list[str]] = {}
    for one in sheet.quantities:
        if one.why:
            unknown.setdefault(one.why, []).append(one.name)
    return render_page(
        "datasheet",
        f"Thermal datasheet of camera {sheet.model.facts.camera_serial}",
        _draw_datasheet_figures(sheet),
        sheet=sheet,
        span=_format_span(sheet) or ["at unknown times"],
        groups=[(name, [*members]) for name, members in groupby(sheet.quantities, key=lambda one: one.group)],
        unknown=unknown,
        measured_with=[*list_stated_details(sheet.details, sheet.observations.target), *equipment],
        versions=", ".join(f"{name} {version}" for name, version in _read_versions().items()),
    )


def _draw_datasheet_figures(sheet: Datasheet) -> Iterator[NamedFigure]:
    yield "temperature", page_figures.draw_over_temperature(sheet)
    if sheet.warming is not None:
        yield "warm-up", page_figures.draw_warm_up(sheet.warming, sheet.by_key["settling_s"].value)


def serialise_datasheet(sheet: Datasheet, equipment: Sequence[Line] = ()) -> str:
    """Every number of the page; what could not be measured is null, and `why` says so."""
    facts = sheet.model.facts
    document = {
        "format": FORMAT,
        "camera": facts.camera_serial,
        "simulated": sheet.observations.simulated,
        "sessions": [one.session_id for one in sheet.observations.sessions],
        "recorded": _format_span(sheet),
        "coverage_factor": COVERAGE,
        "air_degC": [_none_if_not_finite(value) for value in sheet.air_degC],
        "camera_degC": sheet.camera_degC,
        "model": {"form": sheet.model.form, "title": sheet.model.title},
        "equipment": dict(equipment),
        "stated": sheet.details.model_dump(exclude_defaults=True),
        "versions": _read_versions(),
        "quantities": [_serialise_quantity(one) for one in sheet.quantities],
        "quantities_by_session": [[_serialise_quantity(one) for one in session] for session in sheet.by_session]
        if len(sheet.by_session) > 1
        else [],
    }
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _serialise_quantity(one: MeasuredQuantity) -> dict[str, object]:
    return {
        "key": one.key,
        "name": one.name,
        "unit": one.unit,
        "value": _none_if_not_finite(one.value),
        "standard_uncertainty": _none_if_not_finite(one.u),
        "expanded_uncertainty": _none_if_not_finite(one.expanded),
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
        "correlations": [list(each) for each in one.correlations],
    }


def _none_if_not_finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _format_span(sheet: Datasheet) -> list[str]:
    """Return when the first and the last frame were taken; nothing where that is not known."""
    observed = sheet.observations
    if "times" in observed.not_known:
        return []
    utc = [observed.sessions[index].utc for index in (observed.session[0], observed.session[-1])]
    instants = utc[0].utc_ns(int(observed.time_ns[0])), utc[1].utc_ns(int(observed.time_ns[-1]))
    return [_format_utc_ns(ns) for ns in instants]


def _format_utc_ns(ns: int) -> str:
    return f"{datetime.fromtimestamp(ns // 1_000_000_000, UTC):%Y-%m-%d %H:%M} UTC"


def _read_versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in _LIBRARIES}


NOTES = (
    "The results relate only to the item described above, as received and under the conditions stated.",
    "This certificate is reproduced in full only, unless the laboratory that issued it approves otherwise in writing.",
)


def render_certificate_page(made: Certificate, equipment: Sequence[Line] = ()) -> str:
    """Render the certificate as HTML text, which makes a PDF; the same data give the same text."""
    return render_page(
        "certificate",
        "Calibration certificate",
        made=made,
        facts=list_certificate_facts(made),
        groups=[(name, [*members]) for name, members in groupby(made.values, key=lambda one: one.quantity.group)],
        decisions=[_format_decision(one) for one in made.conformities],
        equipment=[*list_stated_details(made.sheet.details, made.sheet.observations.target), *equipment],
        notes=NOTES,
    )


def list_certificate_facts(made: Certificate) -> list[Line]:
    """What ISO/IEC 17025, 7.8.2, asks for, but for the results."""
    order, item = made.order, made.order.item
    first, last = made.performed
    recorded = "" if made.laboratory_degC is None else "laboratory {:.1f} to {:.1f} °C, ".format(*made.laboratory_degC)
    air = "air near the camera {:z.1f} to {:z.1f} °C".format(*made.sheet.air_degC)
    versions = _read_versions()
    return [
        ("Laboratory", "; ".join(order.laboratory.lines)),
        ("Customer", "; ".join(order.customer.lines)),
        ("Item", f"{item.description}: {item.manufacturer} {item.model}, serial number {item.serial_number}"),
        ("Lens", f"{item.lens}, serial number {item.lens_serial_number}"),
        ("Condition as received", item.condition),
        ("Received", order.received.isoformat()),
        ("Calibrated", first.isoformat() if first == last else f"{first.isoformat()} to {last.isoformat()}"),
        ("Issued", order.issued.isoformat()),
        ("Method", order.method),
        ("Conditions", f"{recorded}{air}; {order.conditions}"),
        *((f"Traceability, {name}", text) for name, text in list_references(made)),
        ("Records", "; ".join(_format_record(*each) for each in _list_records(made))),
        ("Software", ", ".join(f"{name} {version}" for name, version in versions.items())),
        *([("Remarks", order.remarks)] if order.remarks else []),
    ]


def list_references(made: Certificate) -> list[Line]:
    """The reference standards and the certificates that trace them to the SI."""
    return [
        (name, f"{one.identification}: certificate {one.certificate} of {one.issued_by}, {one.issued.isoformat()}")
        for name, one in (("target", made.order.target), ("thermometers", made.order.thermometers))
    ]


def _list_records(made: Certificate) -> Iterator[tuple[str, str]]:
    return ((one.session_id, one.digest) for one in made.sessions)


def _format_record(session_id: str, digest: str) -> str:
    return f"session {session_id}" + (f", SHA-256 of its manifest {digest}" if digest else "")


def _format_decision(one: Conformity) -> list[str]:
    quantity = one.value.quantity
    limits = " to ".join(
        ("−∞" if one.lower is None else f"{one.lower:g}", "∞" if one.upper is None else f"{one.upper:g}")
    )
    value = format_with_expanded_uncertainty(quantity.value, one.value.expanded)[0]
    return [quantity.name, limits, value, format_significant(one.guard, 2), quantity.unit, one.verdict]


def render_calibration_page(file: CameraFile, calibration: CameraCalibration) -> str:
    """Render the calibration as HTML text; the same data give the same text."""
    drawn = {
        "residuals": page_figures.draw_residual_vectors,
        "sizes": page_figures.draw_residual_sizes,
        "histogram": page_figures.draw_normalised_histogram,
        "uncertainty": page_figures.draw_uncertainty_map,
        **({"scores": page_figures.draw_model_scores} if calibration.scores else {}),
        "rays": page_figures.draw_rays_against_pinhole,
        "corrections": page_figures.draw_corrections,
    }
    figures = ((name, draw(calibration)) for name, draw in drawn.items())
    return render_page("calibration", f"Calibration of camera {file.camera_serial}", figures, file=file)


def render_validation_page(validation: SpatialValidation) -> str:
    """Render the validation as HTML text; the same validation gives the same text."""
    title = f"Validation of {validation.session_id} in three dimensions"
    return render_page("validation", title, draw_validation_figures(validation), validation=validation)


def draw_validation_figures(validation: SpatialValidation) -> Iterator[NamedFigure]:
    """Draw the figures of that page, which are also those of a part of the report."""
    yield "bars", page_figures.draw_deviation_bars(validation)
    for number, one in enumerate(variant for variant in (validation.after, validation.with_stand) if variant):
        yield f"positions-{number}", page_figures.draw_by_position(validation, one)
