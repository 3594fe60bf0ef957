"""The validation in three dimensions: where the target stood, the paper's Table 1 and figure 15."""

from __future__ import annotations

from collections.abc import Iterator

from compensation.reporting.figures import as_svg
from compensation.reporting.page import Drawing, Heading, Paragraph, Part
from compensation.reporting.table_positions import TablePositions, positions_figure
from compensation.reporting.validation_report import validation_parts
from compensation.validation3d.validation import Validation
from markers.target import Target


def space_section(positions: TablePositions, target: Target, validation: Validation | None) -> Iterator[Part]:
    """What there is of it; nothing when the target was never moved on purpose."""
    if validation is None and not positions.calibration and not positions.poses:
        return
    yield Heading("In three dimensions")
    if positions.calibration or positions.poses:
        yield Drawing(
            as_svg(positions_figure(positions, target), "table"),
            "Where the table held the target, seen from above; the camera looks from the left.",
        )
    if validation is not None:
        yield Paragraph(f"Validated in session {validation.session_id}.", aside=True)
        yield from validation_parts(validation, level=3)
