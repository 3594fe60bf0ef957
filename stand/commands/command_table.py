"""The `stand` command line: which commands there are, and where."""

from __future__ import annotations

import ast
from pathlib import Path

from thermostand.foundation.usage import Lazy, lazy_app

_VERBS = "thermostand.stand.commands.verbs"
_PLAN, _RUN, _CONTROL = (
    "thermostand.stand.commands.plan_cli",
    "thermostand.stand.commands.run_cli",
    "thermostand.stand.commands.control_cli",
)


def _verbs() -> dict[str, Lazy]:
    """The commands of the stand's service that have a verb, from its source: to import it takes longer than the list
    may."""
    found: dict[str, Lazy] = {}
    tree = ast.parse((Path(__file__).parents[1] / "service" / "stand_service.py").read_bytes())
    for method in (each for each in ast.walk(tree) if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)):
        for mark in (each for each in method.decorator_list if isinstance(each, ast.Call)):
            settings = {each.arg: ast.unparse(each.value) for each in mark.keywords}
            if ast.unparse(mark.func) != "command":
                continue
            text = " ".join((ast.get_docstring(method) or "").split())
            for verb in ast.literal_eval(settings.get("verbs", repr((method.name.rstrip("_"),)))):
                if " " not in verb:  # else it stands behind another
                    found[verb] = Lazy(_VERBS, text.partition(". ")[0].rstrip(".") + ".")
    return found


app = lazy_app(
    "Drive the thermal test stand: plan, run, simulate.\n\nExample: stand run thermal-cycle --config my-stand.yaml",
    {
        "plan": Lazy(_PLAN, "The steps of a recipe with durations, frames, bytes and end time, without running it."),
        "simulate": Lazy(_PLAN, "The simulated laboratory in real time, until interrupted."),
        "demo": Lazy(_RUN, "Run a simulated thermal cycle, fit the drift, and print what compensation gains."),
        "run": Lazy(_RUN, "Run a recipe and record it."),
        "serve": Lazy(
            "thermostand.stand.commands.serve_cli", "Own a stand for days: its queue, its page, devices by hand."
        ),
        "service": Lazy("thermostand.stand.commands.service_cli", "The daemon as a systemd service, with udev rules."),
        "resume": Lazy(_RUN, "Resume a run that was killed or interrupted, in its session."),
        "status": Lazy(_CONTROL, "Show what the run under way is doing."),
        "watch": Lazy(_CONTROL, "Follow a run live: its messages and its progress."),
        "foxglove": Lazy(
            "thermostand.stand.commands.foxglove_cli", "Show a running stand live in Foxglove or Lichtblick."
        ),
        **_verbs(),
        "reset": Lazy(_CONTROL, "Continue a run that an interlock holds, once you have removed the cause."),
        "check": Lazy(
            "thermostand.stand.commands.check_cli",
            "Check each device of a stand: connected, the right unit, its settings, a reading.",
        ),
        "device": Lazy("thermostand.stand.commands.device_cli", "Command one device by hand, between runs."),
        "devices": Lazy("thermostand.stand.commands.devices_cli", "What is connected to this computer."),
        "init": Lazy("thermostand.stand.commands.init_cli", "Write the folder of a new stand, from what is connected."),
        "recipes": Lazy("thermostand.stand.commands.installed_cli", "List the installed recipes."),
        "configs": Lazy("thermostand.stand.commands.installed_cli", "List the installed configurations of stands."),
        "config": Lazy("thermostand.stand.commands.config_cli", "Configuration files: JSON Schemas for editors."),
        "queue": Lazy("thermostand.stand.commands.queue_cli", "The queue of a stand: add, list, move, remove."),
        "alert": Lazy("thermostand.stand.commands.alert_cli", "Alerts to people elsewhere: test them."),
        "token": Lazy("thermostand.stand.commands.token_cli", "Tokens for the network: add, list, remove, login."),
        "session": Lazy(
            "thermostand.stand.commands.sessions.session_commands",
            "Recorded sessions: list, look at, verify, repair, replay, export, trim.",
        ),
    },
    has_completion=True,
)
