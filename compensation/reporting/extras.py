"""What a report may have besides drift and compensation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from thermostand.compensation.budget.budget import Budget
from thermostand.compensation.datasheet.details import Details
from thermostand.compensation.reporting.equipment import Line
from thermostand.compensation.reporting.table_positions import TablePositions
from thermostand.compensation.validation3d.validate import Validation


@dataclass(frozen=True, slots=True)
class Extras:
    """budgets: the stand's, by session id. positions: where the table stood. validation: in three dimensions.
    equipment: as the sessions tell it. details: as somebody has stated it."""

    budgets: Mapping[str, Budget] = field(default_factory=dict[str, Budget])
    positions: TablePositions = field(default_factory=TablePositions)
    validation: Validation | None = None
    equipment: Sequence[Line] = ()
    details: Details = field(default_factory=Details)
