"""The result of a validation as text, the paper's beside it."""

from __future__ import annotations

import numpy as np

from thermostand.compensation.drift.drift_model import Outside
from thermostand.compensation.observations import Float
from thermostand.compensation.validation3d.paper import AFTER_mm, BEFORE_mm
from thermostand.compensation.validation3d.validate import Validation


def summary(validation: Validation) -> str:
    """Mean absolute deviation along X, Y, Z with its standard uncertainty, for every variant; rotation and table."""
    width = max(len(one.name) for one in validation.variants) + 2
    where = " (simulated)" if validation.simulated else ""
    lines = [
        f"mean absolute deviation of {', '.join(validation.names)} from {validation.chamber_degC[0]:g} degC over "
        f"{len(validation.chamber_degC) - 1} temperatures{where}, um",
        f"{'':<{width}}{'X':>17}{'Y':>17}{'Z':>17}",
        _paper_line("paper, before", BEFORE_mm, width),
        _paper_line("paper, after", AFTER_mm, width),
    ]
    for one in validation.variants:
        cells = (with_limit(value, u) for value, u in zip(one.mean_um, one.u_mean_um, strict=True))
        lines.append(f"{one.name:<{width}}" + "".join(f"{cell:>17}" for cell in cells))
    table_um, rotation_mrad = validation.after.table_um, validation.after.mean_rotation_mrad
    lines += [
        f"table repeatability from V0 seen again: {_triple(table_um)} um; "
        f"rotation after compensation: {_triple(rotation_mrad, 3)} mrad",
        flagged(validation),
    ]
    return "\n".join(lines)


def with_limit(value_um: float, u_um: float) -> str:
    """A mean absolute value, which is never below 0, so that no symmetrical interval belongs to it: 0.10 (u ≤ 0.69)."""
    return f"{value_um:.2f} (u ≤ {u_um:.2f})"


def flagged(validation: Validation) -> str:
    """What of the corrections was beyond the model's valid range, and why."""
    reasons = Outside(int(np.bitwise_or.reduce(validation.flags[np.isfinite(validation.outside)], axis=None)))
    share = float(np.nanmean(validation.outside))
    if not reasons:
        return "all corrections are within the drift model's valid range"
    poses = int(np.count_nonzero(np.nan_to_num(validation.outside)))
    return (
        f"{share:.1%} of the corrections, at {poses} of {validation.outside.size} poses, are outside the drift model's "
        f"valid range ({', '.join(reason_names(reasons))})"
    )


def reason_names(flags: Outside) -> list[str]:
    """The reasons in a set of flags, in words."""
    return [(flag.name or "").lower().replace("_", " ") for flag in Outside if flag in flags]


def _paper_line(name: str, values_mm: tuple[float, float, float], width: int) -> str:
    return f"{name:<{width}}" + "".join(f"{1e3 * value:>14.1f}" for value in values_mm)


def _triple(values: Float, digits: int = 2) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in values)
