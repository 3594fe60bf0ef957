"""The `stand` command line: which commands there are, and where."""

from __future__ import annotations

import ast
from pathlib import Path

from thermostand.foundation.usage import LazyCommand, make_lazy_app

_VERBS = "thermostand.stand.commands.verbs"
_PLAN, _RUN, _CONTROL = (
    "thermostand.stand.commands.plan_cli",
    "thermostand.stand.commands.run_cli",
    "thermostand.stand.commands.control_cli",
)


def _load_verbs() -> dict[str, LazyCommand]:
    """The commands of the stand's service that have a verb, from its source: to import it takes longer than the list
    may."""
    found: dict[str, LazyCommand] = {}
    tree = ast.parse((Path(__file__).parents[1] / "service" / "stand_service.py").read_bytes())
    for method in (each for each in ast.walk(tree) if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)):
        for mark in (each for each in method.decorator_list if isinstance(each, ast.Call)):
            settings = {each.arg: ast.unparse(each.value) for each in mark.keywords}
            if ast.unparse(mark.func) != "command":
                continue
            text = " ".join((ast.get_docstring(method) or "").split())
            for verb in ast.literal_eval(settings.get("verbs", repr((method.name.rstrip("_"),)))):
                if " " not in verb:  # else it stands behind another
                    found[verb] = LazyCommand(_VERBS, text.partition(". ")[0].rstrip(".") + ".")
    return found


app = make_lazy_app(
    "Drive the thermal test stand: plan, run, simulate.\n\nExample: stand run thermal-cycle --config my-stand.yaml",
    {
        "plan": LazyCommand(
            _PLAN, "The steps of a recipe with durations, frames, bytes and end time, without running it."
        ),
        "simulate": LazyCommand(_PLAN, "The simulated laboratory in real time, until interrupted."),
        "demo": LazyCommand(_RUN, "Run a simulated thermal cycle, fit the drift, and print what compensation gains."),
        "run": LazyCommand(_RUN, "Run a recipe and record it."),
        "serve": LazyCommand(
            "thermostand.stand.commands.serve_cli", "Own a stand for days: its queue, its page, devices by hand."
        ),
        "service": LazyCommand(
            "thermostand.stand.commands.service_cli", "The daemon as a systemd service, with udev rules."
        ),
        "resume": LazyCommand(_RUN, "Resume a run that was killed or interrupted, in its session."),
        "status": LazyCommand(_CONTROL, "Show what the run under way is doing."),
        "overview": LazyCommand(
            "thermostand.stand.commands.overview_cli", "All stands at a glance, and the sessions of all."
        ),
        "watch": LazyCommand(_CONTROL, "Follow a run live: its messages and its progress."),
        "foxglove": LazyCommand(
            "thermostand.stand.commands.foxglove_cli", "Show a running stand live in Foxglove or Lichtblick."
        ),
        **_load_verbs(),
        "reset": LazyCommand(_CONTROL, "Continue a run that an interlock holds, once you have removed the cause."),
        "check": LazyCommand(
            "thermostand.stand.commands.check_cli",
            "Check each device of a stand: connected, the right unit, its settings, a reading.",
        ),
        "device": LazyCommand("thermostand.stand.commands.device_cli", "Command one device by hand, between runs."),
        "devices": LazyCommand("thermostand.stand.commands.devices_cli", "What is connected to this computer."),
        "init": LazyCommand(
            "thermostand.stand.commands.init_cli", "Write the folder of a new stand, from what is connected."
        ),
        "recipes": LazyCommand("thermostand.stand.commands.installed_cli", "List the installed recipes."),
        "configs": LazyCommand(
            "thermostand.stand.commands.installed_cli", "List the installed configurations of stands."
        ),
        "config": LazyCommand(
            "thermostand.stand.commands.config_cli", "Configuration files: JSON Schemas for editors."
        ),
        "queue": LazyCommand("thermostand.stand.commands.queue_cli", "The queue of a stand: add, list, move, remove."),
        "alert": LazyCommand("thermostand.stand.commands.alert_cli", "Alerts to people elsewhere: test them."),
        "token": LazyCommand(
            "thermostand.stand.commands.token_cli", "Tokens for the network: add, list, remove, login."
        ),
        "session": LazyCommand(
            "thermostand.stand.commands.sessions.session_commands",
            "Recorded sessions: list, look at, verify, repair, replay, export, trim.",
        ),
    },
    has_completion=True,
)
