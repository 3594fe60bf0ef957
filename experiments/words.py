"""Steps in words, for people who watch a run."""

from __future__ import annotations

from collections.abc import Mapping

from experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    Decide,
    MoveTo,
    OpenFlap,
    PowerCamera,
    Prompt,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    Step,
    StopChamber,
    step_of,
)
from foundation.errors import ConfigError


def in_words(step: Step) -> str:
    """`soak for 45 min`, `2 frames at 31 °C (fit)`."""
    match step:
        case StartChamber() | SetTemperature():
            return f"{'start the chamber' if isinstance(step, StartChamber) else 'chamber'} at {step.chamber_degC:g} °C"
        case StopChamber():
            return "stop the chamber"
        case Soak():
            return f"soak for {_span(step.duration_s)}"
        case SoakUntilSettled():
            return f"soak at {step.chamber_degC:g} °C until settled, at most {_span(step.max_s)}"
        case OpenFlap():
            return "open the flap"
        case CloseFlap():
            return "close the flap"
        case Capture():
            frames = "frame" if step.frames == 1 else "frames"
            of = f" of {', '.join(step.cameras)}" if step.cameras else ""
            return f"{step.frames} {frames}{of} at {step.chamber_degC:g} °C ({step.role.replace('_', ' ')})"
        case MoveTo():
            return f"move {step.axis} to {step.position:g}"
        case PowerCamera():
            return f"camera {'on' if step.on else 'off'}"
        case CoolDown():
            return f"camera cools down to within {step.band_K:g} K, at most {_span(step.max_s)}"
        case CheckHome():
            return f"check the home of {step.axis}"
        case Prompt():
            return f"ask the operator: {step.text}"
        case Decide():
            return f"decide the next visit, until {1e3 * step.residual_px:g} mpx are predicted"


def doing_in_words(step: str, soaked_again_s: float | None, *, goes_on: bool) -> str:
    """The step under way, in words, and what it waits for. soaked_again_s: how long a camera that was off has soaked
    again, None when it need not. goes_on: whether a soak goes on beyond its time."""
    if goes_on:
        step = f"{step}, and until the chamber has stayed in its band"
    if soaked_again_s is None:
        return step
    soaking = f"the camera was or may have been off and soaks again, for {soaked_again_s / 60:.0f} min so far"
    return f"{soaking}; then: {step}" if step else soaking


def mark_in_words(kind: str, parameters: Mapping[str, object]) -> str:
    """The same of a step as it is recorded; kind and parameters as they are for one of another version."""
    try:
        return in_words(step_of(kind, parameters))
    except ConfigError:
        return " ".join([kind, *(f"{name}={value}" for name, value in parameters.items())])


def _span(duration_s: float) -> str:
    """`45 s`, `3 min 30 s`, `45 min`, `2 h 30 min`."""
    if duration_s < 120.0:
        return f"{duration_s:g} s"
    if duration_s < 600.0 and round(duration_s) % 60:
        return f"{round(duration_s) // 60} min {round(duration_s) % 60} s"
    minutes = round(duration_s / 60.0)
    if minutes < 120:
        return f"{minutes} min"
    return f"{minutes // 60} h" + (f" {minutes % 60} min" if minutes % 60 else "")
