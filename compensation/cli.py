"""The `compensate` command's entry: which commands there are, and where."""

from __future__ import annotations

import sys

from thermostand.foundation.usage import LazyCommand, make_lazy_app

_APPLY, _FIT = "thermostand.compensation.commands.apply_cli", "thermostand.compensation.commands.fit_cli"


app = make_lazy_app(
    "Find markers, fit the thermal drift of a camera, report what compensation gains.\n\n"
    "Example: compensate report sessions/20260101T180000Z-thermal-cycle -o report.html",
    {
        "detect": LazyCommand(
            "thermostand.compensation.commands.detect_cli", "Find the target's markers: a table of centres."
        ),
        "observe": LazyCommand(
            "thermostand.compensation.commands.observe_cli",
            "Pictures and tables of other laboratories: a table of centres to fit.",
        ),
        "fit": LazyCommand(_FIT, "Fit the drift model to the frames of sessions of one camera."),
        "report": LazyCommand(_FIT, "Write the report of sessions of one camera: drift, model, and what it gains."),
        "datasheet": LazyCommand(
            "thermostand.compensation.commands.fit_cli", "Write a camera's thermal datasheet, with uncertainties."
        ),
        "certificate": LazyCommand(
            "thermostand.compensation.commands.certificate_cli", "Issue a calibration certificate: a page and a DCC."
        ),
        "rereference": LazyCommand(_FIT, "Fit a model to where the target is in a new session."),
        "apply": LazyCommand(_APPLY, "Put points or images where they would have been at the reference temperature."),
        "export": LazyCommand(
            _APPLY, "Write the model for other programs: in Python with numpy only, in C, for ROS 2."
        ),
        "calibrate": LazyCommand(
            "thermostand.compensation.commands.calibration_cli", "Calibrate the camera: pinhole and ray model."
        ),
        "calibrate-photographs": LazyCommand(
            "thermostand.compensation.commands.photographs_cli",
            "Calibrate a camera from photographs of a board in any poses.",
        ),
        "calibrate-rig": LazyCommand(
            "thermostand.compensation.commands.photographs_cli",
            "Calibrate cameras that are fixed to each other, from photographs.",
        ),
        "validate": LazyCommand(
            "thermostand.compensation.commands.validate_cli", "How far the target seems to move in space."
        ),
        "budget": LazyCommand("thermostand.compensation.commands.fit_cli", "The stand's error budget, in um and px."),
        "schema": LazyCommand(
            "thermostand.compensation.commands.schema_cli", "JSON Schemas of geometries and details, for editors."
        ),
    },
    has_completion=True,
)


if __name__ == "__main__":
    sys.exit(app())
