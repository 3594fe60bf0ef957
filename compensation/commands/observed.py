"""The markers of the sessions that a command is given, by its options."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from compensation.commands.options import named_target, said_if
from compensation.finding.found import finder
from compensation.observations import Observations, observe
from foundation.progress import progress


def observed(
    sessions: Sequence[Path],
    target: str | None,
    workers: int,
    cluster: str | None,
    *,
    cache: bool,
    across_gap: bool,
    incomplete: bool,
    camera: str | None = None,
) -> Observations:
    """Raises as `observe`, and ConfigError for a target that is neither a file nor installed."""
    wanted, found_by = named_target(target), finder(workers, cluster, use_cache=cache)
    said = said_if(incomplete)
    return observe(sessions, progress, wanted, found_by, across_gap=across_gap, incomplete=said, camera=camera)
