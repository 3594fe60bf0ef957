"""The `stand` command line: which commands there are, and where."""

from __future__ import annotations

from thermostand.foundation.usage import Lazy, lazy_app

_PLAN, _RUN, _CONTROL = (
    "thermostand.stand.commands.plan_cli",
    "thermostand.stand.commands.run_cli",
    "thermostand.stand.commands.control_cli",
)


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
        "pause": Lazy(_CONTROL, "Hold the run before its next action."),
        "continue": Lazy(_CONTROL, "End a pause."),
        "clear": Lazy(_CONTROL, "Continue a run that an interlock holds, once you have removed the cause."),
        "skip": Lazy(_CONTROL, "Leave a step out."),
        "extend": Lazy(_CONTROL, "Soak for longer in a step."),
        "stop": Lazy(_CONTROL, "Make the stand safe and end the run, as Ctrl-C does."),
        "check": Lazy(
            "thermostand.stand.commands.check_cli",
            "Check each device of a stand: connected, the right unit, its settings, a reading.",
        ),
        "submit": Lazy(
            "thermostand.stand.commands.order_cli", "Submit a recipe to the stand's daemon, which queues it."
        ),
        "device": Lazy("thermostand.stand.commands.order_cli", "Command one device by hand, between runs."),
        "devices": Lazy("thermostand.stand.commands.devices_cli", "What is connected to this computer."),
        "init": Lazy("thermostand.stand.commands.init_cli", "Write the folder of a new stand, from what is connected."),
        "recipes": Lazy("thermostand.stand.commands.installed_cli", "List the installed recipes."),
        "configs": Lazy("thermostand.stand.commands.installed_cli", "List the installed configurations of stands."),
        "config": Lazy("thermostand.stand.commands.config_cli", "Configuration files: JSON Schemas for editors."),
        "queue": Lazy("thermostand.stand.commands.queue_cli", "A queue of runs: add, list, move, remove, start."),
        "alert": Lazy("thermostand.stand.commands.alert_cli", "Alerts to people elsewhere: test them."),
        "token": Lazy("thermostand.stand.commands.token_cli", "Tokens for the network: add, list, remove, login."),
        "session": Lazy(
            "thermostand.stand.commands.sessions.session_commands",
            "Recorded sessions: list, look at, verify, salvage, replay, export, trim.",
        ),
    },
    has_completion=True,
)
