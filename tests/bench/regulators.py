"""Our own regulator beside the E5CC: the same chamber, the same steps, over the wires; then ten drawn chambers.

`python -m tests.bench.regulators` prints docs/reference/devices.md's table, with `drawn` that of the drawn chambers.
"""

from __future__ import annotations

import sys
from pathlib import Path

from tests.bench.figures import Figure, report_progress, set_upper_goal
from tests.system.regulator_steps import DRAWN, Step, autotune_in, steps_of


def figures(directory: Path) -> list[Figure]:
    """Goals: 0.1 K at rest, 0.5 K of overshoot, in the standard chamber and, autotuned, in ten drawn ones."""
    found: list[Figure] = []
    for what, seeds in (("standard chamber", (None,)), (f"{len(DRAWN)} drawn chambers", tuple(DRAWN))):
        report_progress(f"our own regulator, autotuned, in {what}")
        steps = [step for seed in seeds for step in steps_of("software-regulator", seed, autotune_in(seed))]
        overshoot_K, worst_K = max(step.overshoot_K for step in steps), max(step.worst_K for step in steps)
        found.append(set_upper_goal(0.5, Figure(f"software regulator, overshoot, {what}", "K", overshoot_K)))
        found.append(set_upper_goal(0.1, Figure("  farthest from the set-point in the last 30 min", "K", worst_K)))
    return found


def _row(name: str, step: Step) -> str:
    columns = (
        f"{step.set_point_degC:g}",
        f"{step.rise_s / 60:.1f}",
        f"{step.overshoot_K:.3f}",
        f"{step.settled_s / 60:.1f}",
        f"{1000 * step.rms_K:.1f}",
        f"{1000 * step.worst_K:.0f}",
        f"{step.cycles_per_h:.0f}",
        f"{step.starts_per_h:.2f}",
    )
    return f"| {' | '.join((name, *columns))} |\n"


def main() -> None:
    """The table, row by row: of the standard chamber, or of the drawn ones."""
    write, is_drawn = sys.stdout.write, "drawn" in sys.argv
    head = (
        "| regulator | to, degC | rise, min | overshoot, K | settled, min | RMS, mK | worst, mK | cycles/h | starts/h |"
    )
    write(f"{head}\n|---|---|---|---|---|---|---|---|---|\n")
    for seed in DRAWN if is_drawn else (None,):
        for step in steps_of("software-regulator", seed, autotune_in(seed)):
            write(_row(f"software, chamber {seed}" if is_drawn else "software", step))
        for step in steps_of("simulated", seed):
            write(_row(f"E5CC, chamber {seed}" if is_drawn else "E5CC", step))
        for step in () if is_drawn else steps_of("simulated", seed, channel="regulator.pv"):
            write(_row("E5CC, by its own probe", step))


if __name__ == "__main__":
    main()
