"""The stand's own part: its error budget."""

from __future__ import annotations

import math
from collections.abc import Iterator

from compensation.budget.budget import Budget, Contribution
from compensation.reporting.numbers import Numbers
from compensation.reporting.page import Heading, Paragraph, Part, Table


def stand_section(numbers: Numbers) -> Iterator[Part]:
    """A table for each session whose budget was asked for."""
    if not numbers.budgets:
        return
    yield Heading("The stand's budget")
    yield Paragraph(
        "What the stand itself does to the image, at its largest over the session's captures, with standard "
        "uncertainties; a line without one is a scatter. It is part of the drift above unless it was corrected."
    )
    for session_id, budget in numbers.budgets.items():
        yield Paragraph(f"{session_id}: {_state(budget)}", aside=True)
        heads = ("contribution", "µm", "± µm", "mpx", "± mpx", "at", "correctable")
        yield Table(heads, [_line(one) for one in budget.contributions])


def _state(budget: Budget) -> str:
    reference, (low, high) = budget.reference, budget.air_degC
    return (
        f"reference with air {reference.air_degC:.2f} °C, granite {reference.granite_inside_degC:.2f} °C inside and "
        f"{reference.granite_outside_degC:.2f} °C outside, artifact {reference.artifact_degC:.2f} °C, laboratory "
        f"{reference.laboratory_degC:.2f} °C; captures with air of {low:.1f} to {high:.1f} °C."
    )


def _line(one: Contribution) -> tuple[str, ...]:
    numbers = (_number(one.um), _number(one.u_um), _number(1e3 * one.px), _number(1e3 * one.u_px))
    return (one.name, *numbers, one.where, "yes" if one.corrected else "")


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else ""
