"""The commands that need no stand: plan, simulate."""

from __future__ import annotations

import json
import signal
from dataclasses import asdict
from datetime import timedelta
from typing import Annotated

import typer

from thermostand.drivers.devices.cameras.shared_line import camera_lines
from thermostand.experiments.looks import looks_of
from thermostand.experiments.steps import Step
from thermostand.foundation.clock import WallClock, seconds_ns
from thermostand.foundation.command_app import App
from thermostand.foundation.ending import Ending
from thermostand.foundation.instants import local_text, utc_text
from thermostand.foundation.output import say, show
from thermostand.stand.commands.reached import (
    ConfigArgument,
    ConfigOption,
    ConfigOrOption,
    RecipeArgument,
    named_config,
)
from thermostand.stand.config.stand_config import load_config, packaged
from thermostand.stand.estimating.absent import absences
from thermostand.stand.estimating.estimate import PricedStep
from thermostand.stand.estimating.learned import load_learned
from thermostand.stand.estimating.run_estimate import price_night
from thermostand.stand.running.order import load_order
from thermostand.stand.simulator import Simulator, laboratory_of, list_faults

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
    learned = load_learned(order.config.recording.directory)
    night = price_night(tuple(order.recipe.plan()), order.config, order.config.recording.directory)
    steps, total_s = night.steps, night.duration_s
    end_ns = WallClock().now_ns() + seconds_ns(total_s)
    totals = {
        "duration_s": total_s,
        "after_s": night.after_s,
        "frames": sum(step.frames for step in steps),
        "bytes": round(sum(step.size_bytes for step in steps)),
        "end": utc_text(end_ns),
    }
    back = [f"then back to the laboratory's temperature, {_hours(night.after_s)}"] if night.after_s else []
    total = (
        f"{len(steps)} steps, {_hours(total_s)}, {totals['frames']} frames, "
        f"{sum(step.size_bytes for step in steps) / 1e9:.2f} GB; started now it ends {local_text(end_ns)}"
    )
    lines = camera_lines(order.config.cameras)
    looks = looks_of(step.planned for step in steps)
    data = {
        "steps": [step.as_json() for step in steps],
        **totals,
        "cameras": [asdict(line) for line in lines],
        "looks": None if looks is None else asdict(looks),
        "absent": (absent := [str(each) for each in absences(order.config)]),
    }
    shared = [str(line) for line in lines if line.shared_by > 1]
    seen = [] if looks is None else [str(looks)]
    show(data, [*map(_line, steps), *back, total, *seen, str(learned), *shared, *absent])


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
    stand_config = load_config(packaged("", named_config(config, by_option)))
    laboratory, ending = laboratory_of(stand_config, virtual=False, seed=None), Ending(_ENDING)
    planned = (*(stand_config.simulation.faults if stand_config.simulation else ()), *(fault or ()))
    simulator = Simulator({**laboratory, "faults": list(planned)})
    say(f"the laboratory of {stand_config.name} answers; Ctrl-C ends it")
    ending.wait()
    simulator.stop()


def _line(step: PricedStep) -> str:
    planned = step.planned
    return (
        f"{planned.index + 1:4d}  {planned.step_id}  {planned.step.kind:<18s}"
        f"{_parameters(planned.step):<72s}{_hours(step.duration_s):>12s}"
        + (f"{step.frames:6d} frames {step.size_bytes / 1e6:8.1f} MB" if step.frames else "")
        + (f"   in band after {_hours(step.in_band_after_s)}" if step.in_band_after_s else "")
        + (f"   {step.warning}" if step.warning else "")
    )


def _parameters(step: Step) -> str:
    return " ".join(f"{name}={value}" for name, value in step.parameters.items())


def _hours(duration_s: float) -> str:
    return str(timedelta(seconds=round(duration_s)))
