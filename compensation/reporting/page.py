"""Pages by templates: one HTML file that needs no other. What a page says is in its template, how it looks in ui.jinja;
every text is escaped. Numbers and figures are given to it.
"""

from __future__ import annotations

import importlib
import logging
import math
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from thermostand.compensation.drift.drift_model import Outside
from thermostand.compensation.drift.evaluation import improvement_percent
from thermostand.compensation.reporting.drawing.drawing import Draw, one_by_one
from thermostand.compensation.reporting.numbers import compact, measured, percent, significant, typeset
from thermostand.compensation.validation3d import paper
from thermostand.compensation.validation3d.document import flagged, reason_names, with_limit
from thermostand.compensation.validation3d.validate import SpatialValidation
from thermostand.foundation.errors import ConfigError

NamedFigure = tuple[str, Figure]
"""The name begins its ids, so that several fit in one page."""
_ROLLED_DEG = 1.0


def page(
    template: str, title: str, figures: Iterable[NamedFigure] = (), draw: Draw = one_by_one, **values: object
) -> str:
    """The page of a template as HTML text: of `values`, and `svg`, the figures by their names."""
    named = list(figures)
    svg = dict(zip((name for name, _ in named), draw([(figure, name) for name, figure in named]), strict=True))
    return _environment().get_template(f"{template}.html.jinja").render(title=title, svg=svg, **values)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("thermostand.compensation", "reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters.update(_FILTERS)
    made.globals.update(paper=paper, flagged=flagged, reasons=_reasons)  # pyright: ignore[reportCallIssue] - as it does
    return made


def mpx(value_px: float, digits: int = 1) -> str:
    """A dash for what is not known."""
    return "–" if math.isnan(value_px) else f"{1e3 * value_px:z.{digits}f}"


def utc(instant: str) -> str:
    """ISO 8601 to what is read on a page."""
    return f"{instant[:16].replace('T', ' ')} UTC"


def orientation(roll_deg: float) -> str:
    """Of a camera, against the first one."""
    if math.isnan(roll_deg):
        return "camera"
    return "normal camera" if abs(roll_deg) < _ROLLED_DEG else f"camera rotated by {abs(roll_deg):z.1f}°"


def _each(values: Iterable[float], spec: str, over: float = 1.0) -> list[str]:
    return [format(value / over, spec) if math.isfinite(value) else "-" for value in values]


def _counts(found: Mapping[str, int], *written: str) -> str:
    return ", ".join(f"{count} {name.replace(*written) if written else name}" for name, count in found.items())


def _reasons(validation: SpatialValidation) -> list[str]:
    return reason_names(Outside(int(np.bitwise_or.reduce(validation.flags, axis=None))))


_FILTERS: dict[str, Any] = {
    "to": format,
    "known": lambda value, spec: format(value, spec) if math.isfinite(value) else "",
    "is_finite": math.isfinite,
    "fine": lambda value, limit, digits: f"{value:z.{digits + (value < limit)}f}",
    "gain": lambda before, after, digits=1: percent(improvement_percent(before, after), digits),
    "mpx": mpx,
    "percent": percent,
    "measured": lambda value, expanded: [*measured(value, expanded)],
    "significant": significant,
    "typeset": typeset,
    "compacts": lambda values, sigmas: [compact(*each) for each in zip(values.tolist(), sigmas.tolist(), strict=True)],
    "utc": utc,
    "orientation": orientation,
    "counts": _counts,
    "each": _each,
    "times": lambda values, factor: [factor * value for value in values],
    "limits": lambda values, sigmas: [with_limit(*each) for each in zip(values, sigmas, strict=True)],
    "rms": lambda values: np.sqrt(np.nanmean(values**2, axis=0)),
    "mean": lambda values, axis=(0, 1): np.nanmean(values, axis=axis),
}


def pdf_of(html: str) -> bytes:
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
    return bytes(weasyprint.HTML(string=html, url_fetcher=_refused).write_pdf())


def _refused(url: str, *_: object, **__: object) -> Any:
    if url.startswith("data:"):
        fetch: Any = importlib.import_module("weasyprint.urls").default_url_fetcher
        return fetch(url)
    raise ValueError(f"{url[:80]}: a page refers to nothing outside of itself")
