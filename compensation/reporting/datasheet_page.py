"""A camera's thermal datasheet: the page, and the same numbers as JSON."""

from __future__ import annotations

import importlib.metadata
import json
import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import groupby

from thermostand.compensation.datasheet.datasheet import Datasheet
from thermostand.compensation.datasheet.quantity import COVERAGE, Quantity
from thermostand.compensation.reporting.drawing import datasheet_figures as figures
from thermostand.compensation.reporting.equipment import Line, stated
from thermostand.compensation.reporting.numbers import measured, percent, significant, typeset
from thermostand.compensation.reporting.page import Drawing, Facts, Heading, Paragraph, Part, Table, page

FORMAT = "thermostand datasheet 1"
_LIBRARIES = ("thermostand", "numpy", "scipy", "opencv-python-headless")


def datasheet_page(sheet: Datasheet, equipment: Sequence[Line] = ()) -> str:
    """As HTML text; the same data give the same text."""
    title = f"Thermal datasheet of camera {sheet.model.facts.camera_serial}"
    return page(title, [*_parts(title, sheet, equipment)])


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


def _plain(one: Quantity) -> dict[str, object]:
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


def _parts(title: str, sheet: Datasheet, equipment: Sequence[Line]) -> Iterator[Part]:
    yield Heading(title, 1)
    yield Paragraph(_lead(sheet), aside=True)
    yield Heading("Results")
    yield Table(("quantity", "value", "U (k = 2)", "unit"), [*_results(sheet.quantities)])
    yield from _unknown(sheet.quantities)
    yield Paragraph(
        "U is the expanded uncertainty: the combined standard uncertainty times k = 2, about 95 % of a normal "
        "distribution. Shifts are of the image's middle, I to the right and J down. Scale is a relative change of the "
        "whole image about its middle, as by a longer focal length. A part of the shift above 100 % is one that "
        "the other part works against."
    )
    yield from _figures(sheet)
    yield Heading("Valid for")
    yield Facts(_valid(sheet))
    yield Heading("Measured with")
    yield Facts([*stated(sheet.details, sheet.observations.target), *equipment, *_software(sheet)])
    yield from _gum(sheet)


def _lead(sheet: Datasheet) -> str:
    begin, end = (_utc(ns) for ns in _span_ns(sheet))
    count = len(sheet.observations.sessions)
    text = f"From {count} session{'s' if count > 1 else ''}, recorded {begin} to {end}."
    return text + (" Recorded in a simulated laboratory: a specimen, no measurement." * sheet.observations.simulated)


def _span_ns(sheet: Datasheet) -> tuple[int, int]:
    observed = sheet.observations
    utc = [observed.sessions[index].utc for index in (observed.session[0], observed.session[-1])]
    return utc[0].utc_ns(int(observed.time_ns[0])), utc[1].utc_ns(int(observed.time_ns[-1]))


def _utc(ns: int) -> str:
    return f"{datetime.fromtimestamp(ns // 1_000_000_000, UTC):%Y-%m-%d %H:%M} UTC"


def _results(quantities: Sequence[Quantity]) -> Iterator[tuple[str, ...]]:
    for group, members in groupby(quantities, key=lambda one: one.group):
        yield (group, "", "", "")
        for one in members:
            if math.isfinite(one.value):
                yield (f"\u2003{one.name}", *measured(one.value, one.expanded), one.unit)
            else:
                yield (f"\u2003{one.name}", "not measured", "", "")


def _unknown(quantities: Sequence[Quantity]) -> Iterator[Part]:
    reasons: dict[str, list[str]] = {}
    for one in quantities:
        if one.why:
            reasons.setdefault(one.why, []).append(one.name)
    for why, names in reasons.items():
        yield Paragraph(f"Not measured: {'; '.join(names)}. The reason: {why}.")


def _figures(sheet: Datasheet) -> Iterator[Part]:
    yield Drawing(
        figures.over_temperature(sheet),
        "temperature",
        "The image's motion from the reference at each visit of a set-point, reached by heating (full) and by cooling "
        "(open). Dashed: the stated coefficient.",
    )
    warming = sheet.warming
    if warming is not None:
        yield Drawing(
            figures.warm_up(warming, sheet.by_key["settling_s"].value),
            "warm-up",
            "Switching on: shift of the image's middle and temperatures in the first warm-up.",
        )


def _valid(sheet: Datasheet) -> list[Line]:
    facts, (low, high) = sheet.model.facts, sheet.air_degC
    columns, rows = facts.hull_px.T
    camera = sheet.camera_degC
    return [
        ("Air near the camera", f"{low:z.1f} to {high:z.1f} °C, at rest at set-points"),
        ("Camera's own sensor", f"{camera[0]:z.2f} to {camera[1]:z.2f} °C"),
        ("Image", f"I {columns.min():z.0f} to {columns.max():z.0f} px, J {rows.min():z.0f} to {rows.max():z.0f} px"),
        ("Reference", f"chamber {facts.reference_chamber_degC:g} °C, camera {facts.reference_degC:z.2f} °C"),
        ("Not covered", "other lenses, focus or aperture; another mount; humidity; vibration; ageing"),
    ]


def _software(sheet: Datasheet) -> list[Line]:
    recorded = dict.fromkeys(one.software_version for one in sheet.observations.sessions)
    return [
        ("Sessions", ", ".join(one.session_id for one in sheet.observations.sessions)),
        ("Model in use", typeset(f"{sheet.model.form}: {sheet.model.title}")),
        ("Software", ", ".join(f"{name} {version}" for name, version in _versions().items())),
        ("Recorded by", f"thermostand {', '.join(recorded)}"),
    ]


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in _LIBRARIES}


def _gum(sheet: Datasheet) -> Iterator[Part]:
    yield Heading("Uncertainty")
    basis = "as stated" if sheet.details.states_u_air else "assumed, since nobody stated it"
    yield Paragraph(
        "After the GUM (JCGM 100:2008): the combined standard uncertainty is the root of the sum of squares of the "
        "contributions, each an input's standard uncertainty times its sensitivity coefficient; the inputs are taken "
        "as uncorrelated. Type A comes from statistics of these recordings, type B from anything else. The air near "
        f"the camera is known to {sheet.details.u_air_K:g} K ({basis})."
    )
    if len(sheet.nights) == 1:
        yield Paragraph(
            "One night was recorded: how the camera differs from night to night is estimated from the scatter within "
            "it. A second session shows it.",
            aside=True,
        )
    heads = ("source", "type", "u of the input", "sensitivity", "contribution", "share")
    for one in sheet.quantities:
        if not math.isfinite(one.value):
            continue
        value, expanded = measured(one.value, one.expanded)
        yield Heading(f"{one.name}: ({value} ± {expanded}) {one.unit}", 3)
        yield Paragraph(f"Model: {one.model}.", aside=True)
        yield Table(heads, [*_budget(one)], chosen=len(one.contributions))


def _budget(one: Quantity) -> Iterator[tuple[str, ...]]:
    whole = one.u**2
    for line in one.contributions:
        share = percent(100 * line.amount**2 / whole) if whole > 0 else "–"
        source = f"{line.source} ({line.basis})"
        ratio = one.unit if line.unit == "1" else f"{one.unit} per {line.unit}"
        sensitivity = "1" if line.sensitivity == 1 else f"{significant(line.sensitivity, 3)} {ratio}"
        input_u, amount = f"{significant(line.u, 2)} {line.unit}", f"{significant(line.amount, 2)} {one.unit}"
        yield (source, line.kind, input_u, sensitivity, amount, share)
    yield ("combined standard uncertainty", "", "", "", f"{significant(one.u, 2)} {one.unit}", "")
