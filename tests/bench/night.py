"""The paper's whole protocol in virtual time: how long it takes, whether it is repeatable, what it leaves in memory."""

from __future__ import annotations

from pathlib import Path

from tests.bench.figures import Figure, at_least, at_most, progress, require_aravis
from tests.system.protocol_night import GROWTH_LIMIT_MB, PROTOCOL, POLL_s, outcomes
from tests.system.simulated_orders import simulated_order

BRIEF_PROTOCOL = PROTOCOL.replace("2700", "300").replace("cycles: 2", "reference_frames: 2")
REPEATS = 3
SPEED_GOAL = 1000  # times real time


def figures(directory: Path) -> list[Figure]:
    """Wall time and memory of the whole protocol; how many of three brief ones are the same to the byte."""
    require_aravis()
    progress(f"{REPEATS} runs of the protocol with brief dwells")
    brief = outcomes(simulated_order(directory, BRIEF_PROTOCOL, POLL_s), directory, REPEATS)
    same = sum(outcome.digest == brief[0].digest for outcome in brief)
    progress("the whole protocol, two to three minutes")
    (night,) = outcomes(simulated_order(directory, PROTOCOL, POLL_s), directory, 1)
    what = f"the paper's protocol, {night.simulated_s / 3600:.1f} h at 1 Hz"
    speed = f"{night.simulated_s / night.wall_s:.0f} x real time"
    grown = f"{night.end_MB:.0f} MB at its end"
    return [
        at_most(round(night.simulated_s / SPEED_GOAL), Figure(what, "s", night.wall_s, speed)),
        at_most(
            GROWTH_LIMIT_MB, Figure("  growth of the daemon from 1 h on", "MB", night.end_MB - night.settled_MB, grown)
        ),
        at_least(REPEATS, Figure("  with brief dwells, same bytes", "runs", same, f"of {REPEATS} runs")),
    ]
