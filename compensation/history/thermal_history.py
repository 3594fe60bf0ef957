"""The recorded history of a camera's surroundings, and the thermal states that follow from it.

From one session: the chamber's air near the camera, the camera's supply and its own temperature. Temperatures are
linear between readings, the supply holds until the next reading or power step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift_runtime import INPUTS, ThermalState
from thermostand.compensation.expression import AIR, POWER, lag
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepState
from thermostand.recording.reading.interpolation import GAP_NS, interpolate
from thermostand.recording.reading.session import Session

# What a camera remembers of its thermal past, at many instants.
#
# The recursion that follows it is that of the runtime (drift_runtime.py): fed sample by sample, from a recording
# (thermal_history.py) or live, it gives the same state.

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ThermalStateSpec:
    """What a model needs remembered: lags and plays (compensation/expression.py), each after those it is made of.
    self_heating_K: of a camera over the air that has been on for long."""

    parts: tuple[Any, ...] = ()
    self_heating_K: float = 15.0

    @property
    def at(self) -> dict[Any, int]:
        """The place of each input, lag and play in a state's values."""
        return {part: place for place, part in enumerate((*INPUTS, *self.parts))}

    @property
    def longest_s(self) -> float:
        """The longest time constant; 0 without one."""
        return max((tau_s for kind, _, tau_s in self.parts if kind == "lag"), default=0.0)

    @property
    def ambient_lag(self) -> Any:
        """The quickest lag of the air; ValueError without one."""
        return min((part for part in self.parts if part[:2] == ("lag", AIR)), key=lambda part: part[2])


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """A camera's thermal state at F instants.

    Attributes
    ----------
    rows
        (F, 3 + P + 2): camera, air and supply, the P lags and plays of `memory`, then `on_s` and `settled_s`; NaN where
        unknown.
    memory
        Which lags and plays these are.
    """

    memory: ThermalStateSpec
    rows: Float

    @classmethod
    def at_degC(cls, camera_degC: float | Float, count: int, memory: ThermalStateSpec | None = None) -> States:
        """Make states at `count` instants of which nothing but the camera's temperature is known, one or (F,)."""
        memory = memory or ThermalStateSpec()
        rows = np.full((count, len(memory.at) + 2), np.nan)
        rows[:, 0] = camera_degC
        return cls(memory, rows)

    @property
    def columns(self) -> Float:
        """(3 + P, F): the values, as `memory.at` places them."""
        return self.rows.T[:-2]

    @property
    def camera_degC(self) -> Float:
        """(F,): its own temperature."""
        return self.rows[:, 0]

    @property
    def on_s(self) -> Float:
        """(F,): since it was switched on, inf when that was before the record."""
        return self.rows[:, -2]

    @property
    def settled_s(self) -> Float:
        """(F,): how long ago the state was a guess, inf when it began as cold as the air."""
        return self.rows[:, -1]

    def of(self, parts: Iterable[Any]) -> Float:
        """(F, N): these inputs, lags or plays. KeyError for what is not remembered."""
        at = self.memory.at
        return np.take(self.rows, [at[part] for part in parts], axis=1)

    def where(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> States:
        """The instants of an index or a mask, in its order."""
        return States(self.memory, self.rows[rows])


def make_initial_state(memory: ThermalStateSpec) -> ThermalState:
    """A camera's thermal state that remembers this, before its first sample."""
    return ThermalState(memory.parts, memory.self_heating_K)


def read_state_row(state: ThermalState) -> Float:
    """The state now, a row of States; all NaN in a gap."""
    return np.array([*state.values, state.on_s, state.settled_s]) + (0.0 if state.begun else math.nan)


TimesNs = NDArray[np.int64]

# Time is in inverse proportion to it.
_STEP_NS = 10 * NS_PER_S
"""How far the state is moved at once: the inputs' means over it are exact, and the fastest lag takes minutes."""

# In factors of about three; their weights are fitted to each session.
_SHAPE_TAUS_S = (40.0, 150.0, 480.0, 1200.0, 4000.0)
_SHAPE_RIDGE = 1e-10  # keeps the system solvable; features are about 1
_FINE_K, _ROUNDING_K = 0.02, 1e-6
"""A display finer than this needs no refinement; readings closer together than that are the same."""
# Twelve terms are fitted to them. Round number; nothing was measured.
_FEWEST_READINGS = 200
_CHANGE_NS = 30 * NS_PER_S
"""Two readings further apart do not show when the display changed."""

_AMBIENT, _POWER = "thermometers.air", "relays.camera_power"


@dataclass(frozen=True, slots=True, eq=False)
class ThermalHistory:
    """One session's record: instants, ns, ascending, and values; without readings that are BAD or suspect.

    ambient_degC: of the air near the camera. powered: 0 or 1, until the next instant. camera_degC: its own reading,
    in steps of resolution_K (0: none), refined within them.
    """

    ambient_ns: TimesNs
    ambient_degC: Float
    powered_ns: TimesNs
    powered: Float
    camera_ns: TimesNs
    camera_degC: Float
    resolution_K: float = 0.0

    @property
    def has_ambient(self) -> bool:
        """Whether lags can be computed at all."""
        return len(self.ambient_ns) > 1


def read_history(session: Session, until_ns: int | None = None) -> ThermalHistory:
    """Return what the session's telemetry has of it, to that instant or its end; a channel that was not recorded is
    empty."""
    columns = (
        _read_good_values(session, _AMBIENT),
        _read_supply(session),
        _read_good_values(session, f"{session.camera}.temperature"),
    )
    ambient, powered, camera = columns if until_ns is None else (_cut_at(column, until_ns) for column in columns)
    return refine_temperature(ThermalHistory(*ambient, *powered, *camera))


def _cut_at(column: tuple[TimesNs, Float], until_ns: int) -> tuple[TimesNs, Float]:
    known = column[0] <= until_ns
    return column[0][known], column[1][known]


def refine_temperature(history: ThermalHistory) -> ThermalHistory:
    """Return the history with the camera's temperature between the steps of its display.

    Many cameras show theirs in quarters of a degree, at which the image moves by several mpx. Where the display changes
    the temperature is half way between its steps. In between runs a linear function of lags of ambient and power,
    fitted to all readings of the session, moved so that it goes through the two changes; the display is never
    overruled by more than half a step.
    """
    step_K = _find_display_step_K(history.camera_degC)
    if step_K < _FINE_K or not history.has_ambient or len(history.camera_ns) < _FEWEST_READINGS:
        return history
    shown, seconds = history.camera_degC, (history.camera_ns - history.camera_ns[0]) / NS_PER_S
    lags = [lag(of, tau_s) for of in (AIR, POWER) for tau_s in _SHAPE_TAUS_S]
    states = compute_states_at(history, ThermalStateSpec(tuple(lags)), history.camera_ns, shown)
    ambient = interpolate(history.ambient_ns, history.ambient_degC, history.camera_ns, GAP_NS)
    terms = np.column_stack([np.ones(len(shown)), ambient, states.of(lags)])
    known = np.isfinite(terms).all(axis=1)
    shape = np.where(known, terms @ solve_damped_least_squares(terms[known], shown[known]), shown)
    changes = np.flatnonzero((np.diff(shown) != 0) & (np.diff(history.camera_ns) < _CHANGE_NS))
    if len(changes) == 0:
        return history
    middle_s = (seconds[changes] + seconds[changes + 1]) / 2
    edge_degC = (shown[changes] + shown[changes + 1]) / 2
    shift = np.interp(seconds, middle_s, edge_degC - np.interp(middle_s, seconds, shape))
    camera_degC = np.clip(shape + shift, shown - step_K / 2, shown + step_K / 2)
    return replace(history, camera_degC=camera_degC, resolution_K=step_K)


def _find_display_step_K(readings_degC: Float) -> float:
    """The smallest difference between two readings that is not rounding; 0 without any."""
    steps = np.diff(np.unique(readings_degC))
    steps = steps[steps > _ROUNDING_K]
    return float(steps.min()) if len(steps) else 0.0


def solve_damped_least_squares(terms: Float, values: Float, ridge: float = _SHAPE_RIDGE) -> Float:
    """(K,) of terms (M, K) and values (M,); what they do not determine is near 0, by a small part `ridge` of the mean
    square of the terms."""
    normal = terms.T @ terms
    damped = normal + ridge * np.trace(normal) / len(normal) * np.eye(len(normal))
    return np.linalg.solve(damped, terms.T @ values)


def _read_good_values(session: Session, channel: str) -> tuple[TimesNs, Float]:
    try:
        times_ns, values = session.believed(channel)
    except SessionError:
        return np.empty(0, np.int64), np.empty(0)
    good = np.isfinite(values)
    return times_ns[good], values[good]


def _read_supply(session: Session) -> tuple[TimesNs, Float]:
    """The relay's readings, and the instants of the steps that switched it: between two readings lie seconds, in which
    a camera that has just been switched on drifts fastest."""
    times_ns, values = _read_good_values(session, _POWER)
    switched = [
        (mark.time_ns, float(bool(mark.parameters.get("on"))))
        for mark in session.steps()
        if mark.kind == "power_camera" and mark.state is StepState.STARTED
    ]
    times_ns = np.concatenate([times_ns, np.array([time_ns for time_ns, _ in switched], np.int64)])
    values = np.concatenate([values, [on for _, on in switched]])
    order = np.argsort(times_ns, kind="stable")
    return times_ns[order], values[order]


def compute_states_at(
    history: ThermalHistory, memory: ThermalStateSpec, time_ns: TimesNs, camera_degC: Float
) -> States:
    """The thermal states at instants (F,), ascending, ns, at which the camera had these temperatures (F,).

    Those that were asked for last are kept, since a fit and its report ask for the same several times: not to be
    written to.
    """
    times_ns, degC = np.asarray(time_ns, np.int64), np.asarray(camera_degC, np.float64)
    return States(memory, _compute_rows(history, memory, times_ns.tobytes(), degC.tobytes()))


# A fit asks for the same states twice and its report up to four times more; following them is a third of a fit.
@lru_cache(maxsize=8)
def _compute_rows(history: ThermalHistory, memory: ThermalStateSpec, times: bytes, temperatures: bytes) -> Float:
    time_ns, camera_degC = np.frombuffer(times, np.int64), np.frombuffer(temperatures, np.float64)
    rows = States.at_degC(camera_degC, len(time_ns), memory).rows
    if history.has_ambient and len(time_ns) and time_ns[-1] > history.ambient_ns[0]:
        begin_ns = int(history.ambient_ns[0])
        marks_ns = np.unique(np.concatenate([np.arange(begin_ns, int(time_ns[-1]) + 1, _STEP_NS), time_ns]))
        marks_ns = marks_ns[marks_ns >= begin_ns]
        camera = _interpolate_camera(history, marks_ns, time_ns, camera_degC)
        inputs = np.column_stack([np.diff(marks_ns) / NS_PER_S, *_average_between(history, marks_ns), camera[1:]])
        found = _follow_samples(memory, inputs, np.minimum(np.searchsorted(marks_ns, time_ns), len(inputs)))
        rows = np.where(np.isfinite(found[:, :1]), found, rows)
    rows.flags.writeable = False
    return rows


def _follow_samples(memory: ThermalStateSpec, inputs: Float, after: NDArray[np.intp]) -> Float:
    """The state's row after so many (F,) of the samples (dt, ambient, power, camera); NaN after none."""
    state, wanted = make_initial_state(memory), set(after.tolist())
    rows = {0: read_state_row(state)}
    for number, sample in enumerate(inputs.tolist(), 1):
        # The run-time's own recursion: states of a whole session at once took 12 ms for 96, which a fit of 2.9 s does
        # not show.
        state.advance(*sample)
        if number in wanted:
            rows[number] = read_state_row(state)
    return np.array([rows[number] for number in after.tolist()])


def _interpolate_camera(history: ThermalHistory, marks_ns: TimesNs, time_ns: TimesNs, camera_degC: Float) -> Float:
    """The camera's temperature at the marks, NaN where it is unknown: at the frames the one recorded with them, refined
    within the display's step by the whole record."""
    camera = interpolate(history.camera_ns, history.camera_degC, marks_ns, GAP_NS)
    at = np.searchsorted(marks_ns, time_ns)
    shown = np.isfinite(camera_degC) & (time_ns >= marks_ns[0])
    known, half_K = camera[at[shown]], history.resolution_K / 2
    own = camera_degC[shown]
    camera[at[shown]] = np.where(np.isfinite(known), np.clip(known, own - half_K, own + half_K), own)
    return camera


def _average_between(history: ThermalHistory, marks_ns: TimesNs) -> tuple[Float, Float]:
    """Average ambient, by the trapezoidal rule, and powered share between the marks (M,), (M - 1,) each; NaN where they
    are not recorded."""
    ambient = interpolate(history.ambient_ns, history.ambient_degC, marks_ns, GAP_NS)
    return (ambient[1:] + ambient[:-1]) / 2, _compute_powered_share(history, marks_ns)


def _compute_powered_share(history: ThermalHistory, marks_ns: TimesNs) -> Float:
    """Exact means of the supply. A camera that reports its temperature is on where the relay was not recorded."""
    if len(history.powered_ns) == 0:
        return np.ones(len(marks_ns) - 1)
    origin_ns = int(marks_ns[0])
    times_s = (history.powered_ns - origin_ns) / NS_PER_S
    marks_s = (marks_ns - origin_ns) / NS_PER_S
    knots_s = np.concatenate([[min(times_s[0], marks_s[0])], times_s, [max(times_s[-1], marks_s[-1]) + 1]])
    held = np.concatenate([history.powered[:1], history.powered])
    area_s = np.concatenate([[0.0], np.cumsum(held * np.diff(knots_s))])
    share = np.diff(np.interp(marks_s, knots_s, area_s)) / np.diff(marks_s)
    return np.where(share > 1 - 1e-9, 1.0, np.clip(share, 0, 1))
