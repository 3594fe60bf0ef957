"""The `stand` command."""

from __future__ import annotations

import asyncio
import itertools
import json
import signal
import sys
import tempfile
from collections.abc import Callable, Collection, Generator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import typer

from compensation.target import load_target
from drivers.clock import NS_PER_S, WallClock
from drivers.interface import ConfigError, SessionError
from experiments.steps import kind_of, parameters_of
from stand import control_cli, queue_cli, session_cli
from stand.config import StandConfig, load_config, packaged
from stand.demo import run_demo
from stand.estimate import PricedStep, price
from stand.exit_codes import INTERRUPTED, one_line_errors
from stand.follow import Follow, parameters_text
from stand.hub import Hub
from stand.learned import learn, load_learned
from stand.progress import progress
from stand.recipe import Recipe, load_recipe
from stand.resume import interruption
from stand.run import Interrupted, resume, run_real, run_virtual
from stand.session_setup import Order
from stand.session_text import salvage_line
from stand.simulator import Simulator, laboratory_of
from stand.usage import OneLineUsage, one_line

app = typer.Typer(
    cls=OneLineUsage,
    no_args_is_help=True,
    add_completion=False,
    help="Drive the thermal test stand: plan, run, simulate.\n\n"
    "Example: stand run thermal-cycle --config my-stand.yaml",
)

app.add_typer(session_cli.app, name="session")
app.add_typer(control_cli.app)
app.add_typer(queue_cli.app, name="queue")

_ENDING = {signal.SIGINT, signal.SIGTERM}

ConfigOption = Annotated[str, typer.Option("--config", help="A configuration file, or the name of an installed one.")]
RecipeArgument = Annotated[str, typer.Argument(help="A recipe file, or the name of an installed one.")]


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option(help="Where the session and the report go; numbered when there is a demo already.")
    ] = Path("demo"),
) -> None:
    """Run a simulated thermal cycle, fit the drift, and print what compensation gains.

    Example: stand demo --out /tmp/demo
    """
    with _run_errors():
        config, recipe = _config("simulated"), _recipe("demo")
        order = _order(config, recipe)
        directory = _unused(out)
        _check_writable(directory)
        with _run_progress(price(recipe[0].plan(), config[0])) as watch:
            session = asyncio.run(run_virtual(order, directory, None, watch))
        for line in run_demo(session, directory):
            typer.echo(line)


@app.command()
def simulate(
    config: Annotated[str, typer.Argument(help="A configuration with a `simulation` section.")] = "simulated",
) -> None:
    """The simulated laboratory in real time, until interrupted: every device answers at its configured address.

    Example: stand simulate & stand run demo
    """
    with one_line_errors():
        stand_config, _ = _config(config)
        simulator = Simulator(laboratory_of(stand_config, virtual=False, seed=None))
        # Blocked only now, or the simulator would inherit it; unblocked, SIGTERM would end us and leave it behind.
        signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
        typer.echo(f"the laboratory of {stand_config.name} answers; Ctrl-C ends it", err=True)
        signal.sigwait(_ENDING)
        simulator.stop()


@app.command()
def plan(
    recipe: RecipeArgument,
    config: ConfigOption = "simulated",
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable.")] = False,
) -> None:
    """The steps of a recipe with durations, frames, bytes and end time, without running anything.

    Example: stand plan thermal-cycle --json
    """
    with one_line_errors():
        stand_config, _ = _config(config)
        learned = load_learned(stand_config.recording.directory)
        steps = price(_recipe(recipe)[0].plan(), stand_config, learned)
        total_s = sum(step.duration_s for step in steps)
        now = datetime.fromtimestamp(WallClock().now_ns() / NS_PER_S, UTC).astimezone()
        end = (now + timedelta(seconds=total_s)).isoformat(timespec="seconds")
        totals = {
            "duration_s": total_s,
            "frames": sum(step.frames for step in steps),
            "bytes": round(sum(step.size_bytes for step in steps)),
            "end": end,
        }
        if as_json:
            typer.echo(json.dumps({"steps": [step.as_json() for step in steps], **totals}, indent=2))
            return
        for step in steps:
            typer.echo(_line(step))
        typer.echo(
            f"{len(steps)} steps, {_hours(total_s)}, {totals['frames']} frames, "
            f"{sum(step.size_bytes for step in steps) / 1e9:.2f} GB; started now it ends {end}"
        )
        typer.echo(str(learned))


@app.command()
def run(
    recipe: RecipeArgument,
    config: ConfigOption = "simulated",
    out: Annotated[Path | None, typer.Option(help="Where the session goes; else recording.directory.")] = None,
    virtual_time: Annotated[
        bool, typer.Option("--virtual-time", help="As fast as it goes, with a simulated laboratory of its own.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="The simulated laboratory's seed (with --virtual-time).")] = None,
) -> None:
    """Run a recipe and record it; prints the session's folder.

    Example: stand run thermal-cycle --config laboratory.yaml --out /data/sessions
    """
    with _run_errors():
        if seed is not None and not virtual_time:
            raise ConfigError("--seed belongs to --virtual-time; a running laboratory has its own seed")
        if seed is not None and seed < 0:
            raise ConfigError(f"--seed is 0 or more, not {seed}")
        config_file, recipe_file = _config(config), _recipe(recipe)
        order = _order(config_file, recipe_file)
        directory = out or config_file[0].recording.directory
        _check_writable(directory)
        steps = price(recipe_file[0].plan(), config_file[0], load_learned(directory))
        with _run_progress(steps) as watch:
            work = run_virtual(order, directory, seed, watch) if virtual_time else run_real(order, directory, watch)
            session = asyncio.run(work)
        _learn(directory, config_file[0])
        typer.echo(session)


@app.command("resume")
def resume_run(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="The session of a run that did not end.")],
    clear: Annotated[bool, typer.Option("--clear", help="The stand tripped, you have seen to it: go on.")] = False,
) -> None:
    """Go on with a run that was killed or interrupted, in its session: what is done is not done again.

    Example: stand resume sessions/20260101T180000Z-thermal-cycle
    """
    with _run_errors():
        before = interruption(directory, clear=clear)
        try:
            for segment in before.salvaged:
                typer.echo(salvage_line(segment), err=True)
            order, folder = before.order, before.directory.parent
            steps = price(order.recipe.plan(), order.config, load_learned(folder))
        except BaseException:
            before.release()
            raise
        with _run_progress(steps, before.progress.done, before.progress.earned_s) as watch:
            session = asyncio.run(resume(before, watch))
        _learn(folder, order.config)
        typer.echo(session)


def _unused(out: Path) -> Path:
    """`out`, or `out-2`, `out-3` ... when it exists: a second demo never touches the first."""
    if not out.name:
        raise ConfigError(f"--out {out}: a demo needs a folder of its own name")
    candidates = (out.with_name(f"{out.name}-{number}") for number in itertools.count(2))
    return out if not out.exists() else next(path for path in candidates if not path.exists())


def _check_writable(directory: Path) -> None:
    """ConfigError when no session could be made below `directory`: to be told before anything is opened."""
    try:
        places = (directory, *directory.absolute().parents)
        existing = next(path for path in places if path.exists() or path.is_symlink())
        Path(tempfile.mkdtemp(prefix=".writable-", dir=existing)).rmdir()
    except OSError as error:
        raise ConfigError(f"{directory}: no session can be written there ({error.strerror})") from error


def _config(name: str) -> tuple[StandConfig, str]:
    path = packaged("", name)
    return load_config(path), path.read_text(encoding="utf-8")


def _recipe(name: str) -> tuple[Recipe, str]:
    path = packaged("recipes", name)
    return load_recipe(path), path.read_text(encoding="utf-8")


def _order(config: tuple[StandConfig, str], recipe: tuple[Recipe, str]) -> Order:
    target = packaged("targets", config[0].target)
    load_target(target)  # only its text is attached, but never one that compensation could not read
    return Order(config[0], recipe[0], config[1], recipe[1], target.read_text(encoding="utf-8"))


@contextmanager
def _run_progress(
    steps: tuple[PricedStep, ...], done: Collection[str] = (), earned_s: Mapping[str, float] = MappingProxyType({})
) -> Generator[Callable[[Hub], None]]:
    """Progress in expected seconds of the plan, the time left as the run goes; warnings and errors as they come."""
    with progress("run", sum(step.duration_s for step in steps)) as report:
        follow = Follow(steps, report, lambda line: typer.echo(line, err=True), done, earned_s)
        yield lambda hub: hub.subscribe(follow)


def _learn(directory: Path, config: StandConfig) -> None:
    """The next plan's durations; what cannot be kept is no reason for a run to fail."""
    try:
        learn(directory, config)
    except (SessionError, OSError) as error:
        typer.echo(f"warning: {one_line(error)}", err=True)


@contextmanager
def _run_errors() -> Generator[None]:
    """As every error; an interrupted run says whether the stand is safe."""
    with one_line_errors():
        try:
            yield
        except Interrupted as error:
            typer.echo(one_line(error), err=True)
            raise typer.Exit(INTERRUPTED) from error


def _line(step: PricedStep) -> str:
    planned = step.planned
    return (
        f"{planned.index:4d}  {planned.step_id}  {kind_of(planned.step):<15s}"
        f"{parameters_text(parameters_of(planned.step)):<72s}{_hours(step.duration_s):>12s}"
        + (f"{step.frames:6d} frames {step.size_bytes / 1e6:8.1f} MB" if step.frames else "")
        + (f"   in band after {_hours(step.in_band_after_s)}" if step.in_band_after_s else "")
        + (f"   {step.warning}" if step.warning else "")
    )


def _hours(duration_s: float) -> str:
    return str(timedelta(seconds=round(duration_s)))


if __name__ == "__main__":
    sys.exit(app())
