"""The drift itself: warm-ups, the thermal cycle, heating against cooling."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from thermostand.compensation.drift.hysteresis import Hysteresis
from thermostand.compensation.observations import Observations
from thermostand.compensation.reporting.drawing import drift_figures as figures
from thermostand.compensation.reporting.drawing.path_figures import EXAGGERATION, Paths, trajectories
from thermostand.compensation.reporting.numbers import Numbers, percent
from thermostand.compensation.reporting.page import Drawing, Heading, Paragraph, Part, Table
from thermostand.compensation.reporting.result_section import ours
from thermostand.compensation.reporting.tracks import Track, WarmUp, cycle, moved_px, visits, warm_ups
from thermostand.experiments.steps import Role

_ROLLED_DEG = 1.0
_MOST_PANELS = 4
_S_PER_MIN = 60.0


def drift_section(observations: Observations, numbers: Numbers) -> Iterator[Part]:
    """Warm-up, cycle and the whole recording; what was not recorded has no figure."""
    if not np.isfinite(moved_px(observations)).any():
        return
    yield from _warm_ups(observations, numbers)
    yield Heading("Drift over temperature" if numbers.hysteresis_before else "Drift over time")
    yield from _cycles(observations, numbers)
    yield Drawing(figures.against_time(observations), "time", _time_caption(observations))


def _time_caption(observations: Observations) -> str:
    text = "Mean drift of the markers, and the temperatures, at each frame."
    if any(session.spots for session in observations.sessions):
        text += " At the foot what a thermal imager saw of the camera: it is right to 2 K, and shows how parts warm."
    if len(observations.sessions) > 1:
        text += " A session begins at each dashed line; the time between them is left out."
    if (observations.role == str(Role.WARM_UP)).any():
        text += " Yellow: the camera warms itself."
    if np.isin(observations.role, figures.MOVED_ON_PURPOSE).any():
        text += " Grey: the target was moved on purpose, which is no drift and is not drawn."
    if _is_dense(observations):
        text += f" Of more than {figures.CURVE_POINTS} frames in a row only so many are drawn, evenly."
    return text


def _is_dense(observations: Observations) -> bool:
    return len(observations.frame) > figures.CURVE_POINTS


def _warm_ups(observations: Observations, numbers: Numbers) -> Iterator[Part]:
    found = warm_ups(observations)
    if not found:
        return
    yield Heading("Warm-up")
    shown = found[:_MOST_PANELS]
    titles = _titles(shown)
    yield Drawing(
        figures.warm_up_curves(observations, shown, titles),
        "warm-up-curves",
        "Mean drift of the markers since the first frame while the camera warms itself, and its own temperature.",
    )
    panels = [_panel(observations, one.track, title) for one, title in zip(shown, titles, strict=True)]
    yield Drawing(
        trajectories(observations, panels),
        "warm-up-paths",
        f"Drift of each marker from its first place (grey disc), enlarged {EXAGGERATION} times. Colour is the camera's "
        "own temperature.",
    )
    if len(found) > len(shown):
        yield Paragraph(f"Of {len(found)} warm-ups the first {len(shown)} are drawn.", aside=True)
    yield _warm_up_table(numbers, len(found) > 1)
    if numbers.model is not None:
        yield Paragraph(
            "Left: RMS of what the model leaves of the deviations from the reference during the warm-up. The thermal "
            "form may have been fitted to these frames, the paper's form was not.",
            aside=True,
        )


def _titles(found: Sequence[WarmUp]) -> list[str]:
    """Normal or rotated, when there are several."""
    if len(found) == 1:
        return [""]
    return [_orientation(one.track.roll_deg - found[0].track.roll_deg) for one in found]


def _orientation(roll_deg: float) -> str:
    if math.isnan(roll_deg):
        return "camera"
    return "normal camera" if abs(roll_deg) < _ROLLED_DEG else f"camera rotated by {abs(roll_deg):z.1f}°"


def _panel(observations: Observations, track: Track, title: str) -> Paths:
    return Paths(title, track.start_px, track.moved_px, observations.camera_degC[track.frames])


def _warm_up_table(numbers: Numbers, several: bool) -> Table:
    i, j = numbers.paper["warm_up_px"]
    rows: list[tuple[str, ...]] = [
        ("paper (measured), camera not modified", "", "", "", f"{i:z.1f}", f"{j:z.1f}", "", "")
    ]
    first_deg = numbers.warm_ups[0].roll_deg
    for one in numbers.warm_ups:
        name = (
            f"{ours(numbers)}, {one.session_id}, {_orientation(one.roll_deg - first_deg)}" if several else ours(numbers)
        )
        begin, end = one.camera_degC
        rows.append(
            (
                name,
                str(one.frames),
                f"{(one.end_s - one.begin_s) / _S_PER_MIN:z.1f}",
                f"{begin:z.1f} to {end:z.1f}",
                f"{one.drift_px[0]:z.3f}",
                f"{one.drift_px[1]:z.3f}",
                *(_mpx(value) for value in one.left_px),
            )
        )
    return Table(("warm-up", "frames", "minutes", "camera, °C", "mean drift I, px", "J", "left I, mpx", "J"), rows)


def _cycles(observations: Observations, numbers: Numbers) -> Iterator[Part]:
    several = len(observations.sessions) > 1
    before, after = (
        {one.session_id: one.gaps for one in found} for found in (numbers.hysteresis_before, numbers.hysteresis_after)
    )
    for index, facts in enumerate(observations.sessions):
        track = cycle(observations, index)
        if track is None:
            continue
        of_session = f" Session {facts.session_id}." if several else ""
        yield Drawing(
            trajectories(observations, [_panel(observations, track, "")]),
            f"cycle-{index}",
            f"Drift of each marker over the thermal cycle, enlarged {EXAGGERATION} times from its place at the "
            f"reference temperature (grey disc). Colour is the camera's own temperature.{of_session}",
        )
        own = visits(observations, track)
        name = facts.session_id
        yield Drawing(
            figures.branches(own, before[name], after.get(name, ())),
            f"branches-{index}",
            "Above: mean drift at each set-point, reached by heating (filled) or by cooling (open). Below: what the "
            f"way there makes of it, with twice its standard uncertainty.{of_session}",
        )
    if any(one.gaps for one in numbers.hysteresis_before):
        yield _hysteresis_table(numbers, several)
        yield Paragraph(
            "Heating minus cooling, of the mean over the markers, at set-points reached from both sides; lag and "
            "hysteresis both open the branches. Closure: last visit of the reference set-point minus the first. "
            "Repeatability: standard deviation of visits of the same set-point from the same side.",
            aside=True,
        )


def _hysteresis_table(numbers: Numbers, several: bool) -> Table:
    heads = ("mpx", "range", "largest gap", "of the drift", "RMS gap", "area, mpx K", "closure", "repeatability")
    after = {one.session_id: one for one in numbers.hysteresis_after}
    rows: list[tuple[str, ...]] = []
    for before in numbers.hysteresis_before:
        named = f", {before.session_id}" if several else ""
        both = [("before", before), ("after", after.get(before.session_id))]
        for axis, coordinate in enumerate("IJ"):
            whole_px = float(before.range_px[axis])
            rows += [
                (f"{coordinate} {when}{named}", *_hysteresis_cells(one, axis, whole_px))
                for when, one in both
                if one is not None
            ]
    return Table(heads, rows)


def _hysteresis_cells(one: Hysteresis, axis: int, whole_px: float) -> Iterator[str]:
    """whole_px: range of the drift before compensation."""
    largest_px = float(one.largest_px[axis])
    yield _mpx(float(one.range_px[axis]))
    yield _mpx(largest_px)
    yield "–" if math.isnan(largest_px) or whole_px <= 0 else percent(100 * largest_px / whole_px)
    for values in (one.rms_px, one.area_px_K, one.closure_px, one.repeatability_px):
        yield _mpx(float(values[axis]))


def _mpx(value_px: float) -> str:
    """A dash for what is not known."""
    return "–" if math.isnan(value_px) else f"{1e3 * value_px:z.1f}"
