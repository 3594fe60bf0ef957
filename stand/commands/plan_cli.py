"""The commands that need no stand: plan, simulate."""

from __future__ import annotations

import json
import signal
from dataclasses import asdict
from datetime import timedelta
from typing import Annotated

import typer

from thermostand.drivers.devices.cameras.shared_line import compute_line_shares
from thermostand.experiments.detectability import estimate_detectability
from thermostand.experiments.steps import Step
from thermostand.foundation.clock import WallClock, to_ns
from thermostand.foundation.command_app import App
from thermostand.foundation.instants import format_local, format_utc
from thermostand.foundation.output import say, show
from thermostand.foundation.stop_signal import StopSignal
from thermostand.stand.assembly.simulator import Simulator, describe_laboratory, list_faults
from thermostand.stand.commands.endpoint import (
    ConfigArgument,
    ConfigOption,
    ConfigOrOption,
    RecipeArgument,
    choose_config,
)
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.estimating.estimate import PricedStep
from thermostand.stand.estimating.learned_durations import load_learned_durations
from thermostand.stand.estimating.missing_devices import list_missing_devices
from thermostand.stand.estimating.run_estimate import estimate_plan
from thermostand.stand.running.order import load_order

app = App()

_ENDING = {signal.SIGINT, signal.SIGTERM}


@app.command()
def plan(
    recipe: RecipeArgument,
    config: ConfigOption = "simulated",
) -> None:
    """The steps of a recipe with durations, frames, bytes and end time, without running anything.

    Example: stand plan thermal-cycle --json
    """
    order = load_order(recipe, config)
    learned = load_learned_durations(order.config.recording.directory)
    estimate = estimate_plan(tuple(order.recipe.plan()), order.config, order.config.recording.directory)
    steps, total_s = estimate.steps, estimate.duration_s
    end_ns = WallClock().now_ns() + to_ns(total_s)
    totals = {
        "duration_s": total_s,
        "after_s": estimate.after_s,
        "frames": sum(step.frames for step in steps),
        "bytes": round(sum(step.size_bytes for step in steps)),
        "end": format_utc(end_ns),
    }
    back = [f"then back to the laboratory's temperature, {_format_hours(estimate.after_s)}"] if estimate.after_s else []
    total = (
        f"{len(steps)} steps, {_format_hours(total_s)}, {totals['frames']} frames, "
        f"{sum(step.size_bytes for step in steps) / 1e9:.2f} GB; started now it ends {format_local(end_ns)}"
    )
    lines = compute_line_shares(order.config.cameras)
    looks = estimate_detectability(step.planned for step in steps)
    data = {
        "steps": [step.as_json() for step in steps],
        **totals,
        "cameras": [asdict(line) for line in lines],
        "looks": None if looks is None else asdict(looks),
        "absent": (absent := [str(each) for each in list_missing_devices(order.config)]),
    }
    shared = [str(line) for line in lines if line.shared_by > 1]
    seen = [] if looks is None else [str(looks)]
    show(data, [*map(_format_step, steps), *back, total, *seen, str(learned), *shared, *absent])


@app.command()
def simulate(
    config: ConfigArgument = None,
    by_option: ConfigOrOption = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="NAME[=VALUE][@TIME][:DURATION]", help="Break something; may be repeated."),
    ] = None,
    faults: Annotated[bool, typer.Option("--faults", help="List what can be broken, and end.")] = False,
) -> None:
    """The simulated laboratory in real time, until interrupted: every device answers at its configured address.

    Example: stand simulate --fault bus.drop=0.1@60:30 & stand run demo
    """
    if faults:
        rows = list_faults()
        show(rows, (f"{row['name']:<32}{json.dumps(row['worst']):<18}{row['text']}" for row in rows))
        return
    stand_config = load_config(find_packaged("", choose_config(config, by_option)))
    laboratory, ending = describe_laboratory(stand_config, virtual=False, seed=None), StopSignal(_ENDING)
    planned = (*(stand_config.simulation.faults if stand_config.simulation else ()), *(fault or ()))
    simulator = Simulator({**laboratory, "faults": list(planned)})
    say(f"the laboratory of {stand_config.name} answers; Ctrl-C ends it")
    ending.wait()
    simulator.stop()


def _format_step(step: PricedStep) -> str:
    planned = step.planned
    return (
        f"{planned.index + 1:4d}  {planned.step_id}  {planned.step.kind:<18s}"
        f"{_format_parameters(planned.step):<72s}{_format_hours(step.duration_s):>12s}"
        + (f"{step.frames:6d} frames {step.size_bytes / 1e6:8.1f} MB" if step.frames else "")
        + (f"   in band after {_format_hours(step.in_band_after_s)}" if step.in_band_after_s else "")
        + (f"   {step.warning}" if step.warning else "")
    )


def _format_parameters(step: Step) -> str:
    return " ".join(f"{name}={value}" for name, value in step.parameters.items())


def _format_hours(duration_s: float) -> str:
    return str(timedelta(seconds=round(duration_s)))
