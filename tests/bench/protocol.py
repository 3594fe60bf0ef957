"""The paper's whole protocol in virtual time: how long it takes, whether it is repeatable, what it leaves in memory."""

from __future__ import annotations

from pathlib import Path

from tests.bench.figures import Figure, report_progress, require_aravis, set_lower_goal, set_upper_goal
from tests.system.protocol_run import GROWTH_LIMIT_MB, PROTOCOL, POLL_s, outcomes
from tests.system.simulated_orders import simulated_order

BRIEF_PROTOCOL = PROTOCOL.replace("2700", "300").replace("cycles: 2", "reference_frames: 2")
REPEATS = 3
SPEED_GOAL = 1000  # times real time


def figures(directory: Path) -> list[Figure]:
    """Wall time and memory of the whole protocol; how many of three brief ones are the same to the byte."""
    require_aravis()
    report_progress(f"{REPEATS} runs of the protocol with brief dwells")
    brief = outcomes(simulated_order(directory, BRIEF_PROTOCOL, POLL_s), directory, REPEATS)
    same = sum(outcome.digest == brief[0].digest for outcome in brief)
    report_progress("the whole protocol, two to three minutes")
    (only,) = outcomes(simulated_order(directory, PROTOCOL, POLL_s), directory, 1)
    what = f"the paper's protocol, {only.simulated_s / 3600:.1f} h at 1 Hz"
    speed = f"{only.simulated_s / only.wall_s:.0f} x real time"
    grown = f"{only.end_MB:.0f} MB at its end"
    return [
        set_upper_goal(round(only.simulated_s / SPEED_GOAL), Figure(what, "s", only.wall_s, speed)),
        set_upper_goal(
            GROWTH_LIMIT_MB, Figure("  growth of the daemon from 1 h on", "MB", only.end_MB - only.settled_MB, grown)
        ),
        set_lower_goal(REPEATS, Figure("  with brief dwells, same bytes", "runs", same, f"of {REPEATS} runs")),
    ]
