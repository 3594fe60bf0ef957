"""The page of a validation in three dimensions: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from thermostand.compensation.drift.drift_model import Outside
from thermostand.compensation.drift.evaluation import improvement_percent
from thermostand.compensation.observations import Float
from thermostand.compensation.reporting.drawing import validation_figures as figures
from thermostand.compensation.reporting.numbers import percent
from thermostand.compensation.reporting.page import Drawing, Facts, Heading, Paragraph, Part, Table, page
from thermostand.compensation.validation3d.paper import TABLE_1, AFTER_mm, BEFORE_mm
from thermostand.compensation.validation3d.validate import Validation
from thermostand.compensation.validation3d.validation_text import flagged, reason_names, with_limit

_HEADS = ("Temp., °C", "Pos.", *(f"{axis} {when}, mm" for when in ("before", "after") for axis in figures.AXES))


def validation_page(validation: Validation) -> str:
    """The report as HTML text; the same validation gives the same text."""
    title = f"Validation of {validation.session_id} in three dimensions"
    simulated = [Paragraph("The laboratory was simulated.", aside=True)] if validation.simulated else []
    return page(title, [Heading(title, 1), *simulated, *validation_parts(validation)])


def validation_parts(validation: Validation, level: int = 2) -> list[Part]:
    """What a page says of the validation, under headings of this level."""
    return [
        Heading("Result", level),
        gains_table(validation),
        _uncertainties(validation),
        Paragraph(_method(validation)),
        Heading("Deviations by temperature", level),
        Drawing(
            figures.bars(validation),
            "bars",
            "Mean absolute deviation of the positions at each temperature but the reference, before (blue) and after "
            "(orange) compensation, in the form of the paper's figure 15; dashed are the paper's means.",
        ),
        *_by_position(validation),
        Heading("Table in the form of the paper's Table 1", level),
        Table(_HEADS, list(_rows(validation))),
        Paragraph("Translation deviation, mm; Temp. is the camera's own temperature, °C. * outside the valid range."),
        Paragraph(flagged(validation) + "."),
        Heading("The paper's Table 1", level),
        Table(_HEADS, list(_paper_rows())),
        Heading("Rotation, table and uncertainty", level),
        _other(validation),
        Facts(_facts(validation)),
    ]


def gains_table(validation: Validation, ours: str = "this session") -> Table:
    """Mean absolute deviations before and after, beside the paper's."""
    rows = [
        ["paper", *_gains([1e3 * mm for mm in BEFORE_mm], [1e3 * mm for mm in AFTER_mm])],
        [ours, *_gains(validation.before.mean_um.tolist(), validation.after.mean_um.tolist())],
    ]
    heads = [cell for axis in figures.AXES for cell in (f"{axis} before", "after", "gain")]
    return Table(["mean |deviation|, µm", *heads], rows, 1)


def _uncertainties(validation: Validation) -> Table:
    uncertain = [
        [one.name, *(with_limit(value, u) for value, u in zip(one.mean_um, one.u_mean_um, strict=True))]
        for one in validation.variants
    ]
    return Table(["mean |deviation| and the limit of its standard uncertainty, µm", *figures.AXES], uncertain)


def _gains(before_um: Sequence[float], after_um: Sequence[float]) -> Iterator[str]:
    for before, after in zip(before_um, after_um, strict=True):
        yield from (
            f"{before:z.1f}",
            f"{after:z.1f}" if after >= 10 else f"{after:z.2f}",
            percent(improvement_percent(before, after), 0),
        )


def _method(validation: Validation) -> str:
    text = (
        f"Mean absolute translation of the target at {', '.join(validation.names)} against its place at "
        f"{validation.chamber_degC[0]:g} °C, over {len(validation.chamber_degC) - 1} temperatures. The pose is that of "
        "the target's middle by the calibration at the reference; frames of a position are averaged. Axes are the "
        "camera's: X to the right in the image, Y down, Z away from the camera. The uncertainty takes those of the "
        "poses as fully correlated: an upper limit."
    )
    if validation.with_stand is None:
        return text
    return (
        text + " The stand moves the target, too. Before compensation its part is taken out to show the camera alone. "
        "The drift model was fitted with the stand's part in it, as seen at the distance of the fit; the last line "
        "takes it as seen at each position's own distance."
    )


def _by_position(validation: Validation) -> Iterator[Part]:
    for number, one in enumerate(variant for variant in (validation.after, validation.with_stand) if variant):
        drawn = figures.by_position(validation, one)
        yield Drawing(drawn, f"positions-{number}", f"Deviations {one.name}; lines are standard uncertainties.")


def _rows(validation: Validation) -> Iterator[list[str]]:
    for index in range(1, len(validation.chamber_degC)):
        for position, name in enumerate(validation.names):
            mark = " *" if validation.flags[index, position] else ""
            moved = [one.translation_um[index, position] for one in (validation.before, validation.after)]
            yield [_degC(validation.camera_degC[index]) if position == 0 else "", name + mark, *_mm(moved)]
        means = [one.per_temperature_um[index] for one in (validation.before, validation.after)]
        yield ["", "aver (abs)", *_mm(means)]


def _paper_rows() -> Iterator[list[str]]:
    for one in TABLE_1:
        for position, pair in enumerate(zip(one.before_mm, one.after_mm, strict=True)):
            cells = (f"{value:z.4f}" for value in chain(*pair))
            yield [_degC(one.camera_degC) if position == 0 else "", f"V{position}", *cells]
        yield ["", "aver (abs)", *(f"{value:z.4f}" for value in (*one.mean_before_mm, *one.mean_after_mm))]


def _mm(values_um: Sequence[Float]) -> list[str]:
    return [f"{value / 1e3:z.4f}" if np.isfinite(value) else "-" for value in np.concatenate(values_um)]


def _degC(value: float) -> str:
    return f"{value:z.2f}"


def _other(validation: Validation) -> Table:
    before, after = validation.before, validation.after
    lines = [
        ["mean |rotation| before, mrad", *_numbers(before.mean_rotation_mrad, 4)],
        ["mean |rotation| after, mrad", *_numbers(after.mean_rotation_mrad, 4)],
        ["V0 again, RMS after, µm", *_numbers(np.sqrt(np.nanmean(after.repeat_um**2, axis=0)), 2)],
        ["table repeatability, one visit, µm", *_numbers(after.table_um, 2)],
        ["u by the markers' noise, µm", *_numbers(np.nanmean(after.noise_um[1:], axis=(0, 1)), 2)],
        ["u by the drift model, µm", *_numbers(np.nanmean(after.model_um[1:], axis=(0, 1)), 2)],
    ]
    return Table(["", *figures.AXES], lines)


def _numbers(values: Float, digits: int) -> list[str]:
    return [f"{value:.{digits}f}" for value in values]


def _facts(validation: Validation) -> list[tuple[str, str]]:
    positions = ", ".join(
        f"{name} {linear:z.3f} mm {rotary:z.3f}° (at {distance:z.0f} mm)"
        for name, linear, rotary, distance in zip(
            validation.names, validation.linear_mm, validation.rotary_deg, validation.distance_mm, strict=True
        )
    )
    reasons = reason_names(Outside(int(np.bitwise_or.reduce(validation.flags, axis=None))))
    return [
        ("Positions", positions),
        ("Camera model", validation.lens),
        ("Drift model", validation.model),
        ("Frames", f"{int(validation.frame_count.sum())}, averaged by position and temperature"),
        ("Outside because of", ", ".join(reasons) or "nothing"),
        (
            "Misfit of the poses",
            f"chi {np.nanmean(validation.before.chi):z.2f} before, "
            f"{np.nanmean(validation.after.chi):z.2f} after; 1 when noise explains it",
        ),
        ("Drift model's errors", "taken as a smooth field, alike over half of the image's width"),
    ]
