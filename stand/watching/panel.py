"""A moment of a run as text: a panel of a few lines on a terminal, one line elsewhere."""

from __future__ import annotations

from thermostand.foundation.instants import duration, local_text
from thermostand.foundation.usage import one_line
from thermostand.stand.watching.moment import Moment

_BAR = 24


def panel_lines(moment: Moment) -> list[str]:
    """What stands in the panel, a line for each question: what, how warm, what has been seen, how long."""
    lines = [_step(moment), "   ".join(_temperatures(moment)), "   ".join(_recorded(moment)), _end(moment)]
    return [one_line(line) for line in lines if line]


def plain_line(moment: Moment) -> str:
    """The same in one line, for a log."""
    parts = [_step(moment), ", ".join(_temperatures(moment)), ", ".join(_recorded(moment)), _ends(moment)]
    share = "" if moment.share is None else f"{moment.share:4.0%}  "
    return one_line(f"run: {share}{local_text(moment.now_ns)[:16]}  {'; '.join(part for part in parts if part)}")


def _step(moment: Moment) -> str:
    number = f"step {moment.step} of {moment.steps}: " if moment.steps else ""
    return f"{number}{moment.doing}" + (f" ({moment.held})" if moment.held else "")


def _temperatures(moment: Moment) -> list[str]:
    named = (("set", moment.setpoint_degC), ("air", moment.air_degC), ("camera", moment.camera_degC))
    return [f"{name} {'–' if value is None else f'{value:.2f} °C'}" for name, value in named]


def _recorded(moment: Moment) -> list[str]:
    planned = moment.frames_planned
    of = f" of {planned}" if planned is not None and planned >= moment.frames else ""
    parts = [f"frames {moment.frames}{of}"] if moment.steps else []
    if moment.frames_lost:
        parts.append(f"{moment.frames_lost} LOST")
    if moment.drift_px is not None:
        parts.append(f"drift {moment.drift_px:.3f} px")
    if moment.disk_free_bytes is not None:
        parts.append(f"disk {moment.disk_free_bytes / 1e9:.1f} GB free")
    return parts


def _ends(moment: Moment) -> str:
    if moment.end_ns is None:
        return ""
    within = "" if moment.end_within_s is None else f" ± {_minutes(moment.end_within_s)}"
    left = duration(max(0, moment.end_ns - moment.now_ns))
    zone = local_text(moment.end_ns)[19:]
    return f"ends {local_text(moment.end_ns)[:16]}{zone}{within} (in {left})"


def _end(moment: Moment) -> str:
    if moment.share is None:
        return _ends(moment)
    done = round(_BAR * moment.share)
    return f"{'━' * done}{'╌' * (_BAR - done)} {moment.share:.0%}   {_ends(moment)}"


def _minutes(duration_s: float) -> str:
    minutes = round(duration_s / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes / 60.0:.1f} h"
