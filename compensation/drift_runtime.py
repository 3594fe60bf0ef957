"""Applies a thermostand drift model to a running camera. This file and a JSON file are all it takes, with numpy.

    drift = Drift.load("drift.json")
    drift.advance(dt_s, ambient_degC, power_on, camera_degC)   # every few seconds, from switching on
    reference_px = drift.correct(points_px)                    # (N, 2), x to the right, y down, px
    drift.flags(points_px)                                     # (N,), 0 inside the calibrated range
    image = cv2.remap(image, *drift.maps(), cv2.INTER_LANCZOS4)   # for programs that want pixels

Integer pixel coordinates are pixel centres. A model of the form `paper` uses the camera's temperature only; one of the
form `thermal` remembers the air, the supply and the camera, and must be fed for about three of its longest time
constants (`drift.memory_s`) before it is right, unless it was fed from a cold start on.

The fit, too, follows the camera with the ThermalState of this file.
"""

import json
import math

import numpy as np

PLACE, CAMERA, AMBIENT, SWITCHED_ON, HISTORY, STATE = 1, 2, 4, 8, 16, 32
"""Flags: the point is outside the markers' hull; the camera's temperature, or the air's, is outside the
calibrated range; the camera was switched on too recently; it has not been followed for long enough; each is in its
range, but not in this combination."""

VERSION = 4
"""Of the JSON file. From thermostand 0.2.0 on each version reads the files of all before it."""

# Half of it would leave 22 % of the guess, and twice would double the time after which a model without its own
# `history_s` answers without a flag.
SETTLED_TAUS = 3.0
"""After so many time constants a state that began with a guess has forgotten it (5 % are left)."""
COLD_K = 3.0
"""A camera this close to the air around it has been off for long: nothing of it is warm."""
# Assumed. A camera with half or twice this time constant is guessed wrong by a quarter of its excess at most.
UNPOWERED_TAU_S = 900.0
"""An unpowered camera reports no temperature; its excess over the air is assumed to decay so until it does."""
HULL_MARGIN_PX = 1.0  # the markers themselves move by about so much
COLDEST_degC, HOTTEST_degC = -273.15, 1000.0
MOST_CORNERS = 2000
"""Corners of a hull, at most: that of a session's markers has about 40. Each point is compared with each corner."""
MOST_IMAGES = 1000
"""The terms of a correction are not larger in all: those of a fit to few temperatures cancel each other, and of a table
of centres they were five images."""
LATTICE_PX, ROUNDS = 16, 4
"""Maps are worked out every 16 px; the shift changes by some 1e-4 px per px, and each round of its inverse gains four
digits."""
_MARGIN, _SWITCHED_ON_S, _MORE_LEVERAGE = 0.02, 1.0, 3.0


_OPERATIONS = {
    "+": lambda one, other: one + other,
    "-": lambda one, other: one - other,
    "*": lambda one, other: one * other,
    "/": lambda one, other: one / other,
    "**": lambda one, other: one**other,
}
INPUTS = (("camera",), ("air",), ("power",))
"""Of a thermal state: temperature of the camera and of the air near it, degC, and its supply, 0..1. Expressions are
made of these and of numbers: (operation, one, other); ("lag", of, tau_s), a first-order follower; ("play", of,
radius_K), a Prandtl-Ishlinskii play, which stays where it is until what it follows is further away than its radius."""


def compiled(expression, at):
    """A function of a list of values, numbers or arrays: what the expression is of them. at: where inputs, lags and
    plays are in the list. ValueError for what is no expression of these."""
    if isinstance(expression, (int, float)):
        return lambda values: expression
    if expression in at:
        place = at[expression]
        return lambda values: values[place]
    if len(expression) != 3 or expression[0] not in _OPERATIONS:
        raise ValueError(f"{expression} is no expression of a thermal state")
    operation = _OPERATIONS[expression[0]]
    one, other = (compiled(part, at) for part in expression[1:])
    return lambda values: operation(one(values), other(values))


def remembered(expressions):
    """The lags and plays in the expressions, each once and after those it is made of."""
    found = {}
    for expression in expressions:
        if isinstance(expression, tuple):
            found.update(dict.fromkeys(remembered(expression[1:])))
            if expression[0] in ("lag", "play"):
                found[expression] = None
    return tuple(found)


class Follower:
    """Lags and plays, each after those it is made of, followed in a list of values: the inputs, then these. The values
    are numbers, or arrays of many cameras. at: where each is in the list."""

    def __init__(self, parts):
        """ValueError for what is no lag or play of known ones."""
        self.at = {one: place for place, one in enumerate(INPUTS)}
        self.parts = []
        for part in parts:
            self.parts.append((len(self.at), compiled(part[1], self.at), part[0] == "play", part[2]))
            self.at[part] = len(self.at)
        self.taus_s = np.array([size for _, _, is_play, size in self.parts if not is_play])

    def rest(self, values):
        """The values with those of equilibrium at these inputs."""
        values = list(values)
        for _, followed, _, _ in self.parts:
            values.append(followed(values))
        return values

    def follow(self, now, mean, gained, clip):
        """Move lags and plays on, in place. now: with new inputs; mean: with their means over the time that has passed.
        gained: 1 - exp(-dt / tau) of each lag, exact for a constant input."""
        gained = iter(gained)
        for place, followed, is_play, radius_K in self.parts:
            if is_play:
                push = followed(now)
                now[place] = mean[place] = clip(now[place], push - radius_K, push + radius_K)
            else:
                before = now[place]
                now[place] = before + (followed(mean) - before) * next(gained)
                mean[place] = (before + now[place]) / 2


class ThermalState:
    """The thermal state of one camera, followed from sample to sample.

    It begins, and begins again after a gap, in equilibrium: lags of temperatures at these temperatures, lags of the
    power at the part of its self-heating that the camera shows. Unless the camera is as cold as the air when it is
    first seen, or when it is switched on after it was unpowered until then, that is a guess, which is forgotten after
    about three of the time constants. values: camera, air and supply now, then lags and plays as `memory` lists them.
    settled_s: how long ago the state was a guess. on_s: since the camera was switched on. begun: False in a gap.
    """

    def __init__(self, memory, self_heating_K):
        """memory: lags and plays. self_heating_K: over the air of a camera that has been on for long."""
        self.memory = Follower(memory)
        self._self_heating_K = self_heating_K
        self._dt_s, self._gained = math.nan, []
        self.begun = self._unseen = False
        self.settled_s = self.on_s = math.nan
        self.values = [math.nan] * len(self.memory.at)  # a list: for so few numbers numpy takes three times as long

    @property
    def camera_degC(self):
        """The camera's temperature, as it was given or is assumed."""
        return self.values[0]

    def advance(self, dt_s, ambient_degC, power_on, camera_degC):
        """dt_s have passed, with this mean temperature of the air near the camera and this share (0..1) of them
        powered; at their end the camera has this temperature (NaN: unknown). An unknown ambient is a gap, and so is a
        time or a share that cannot be."""
        camera_degC = camera_degC if is_temperature(camera_degC) else math.nan
        if not (0 <= dt_s < math.inf and is_temperature(ambient_degC) and 0 <= power_on <= 1):
            self.begun = False
            return
        if not self.begun:
            self._begin(ambient_degC, power_on, camera_degC)
        before_degC, air_degC, _, *before = self.values
        excess_K = (before_degC - air_degC) * math.exp(-dt_s / UNPOWERED_TAU_S)
        own_degC = ambient_degC + excess_K if math.isnan(camera_degC) else camera_degC
        if dt_s != self._dt_s:
            self._dt_s, self._gained = dt_s, (-np.expm1(-dt_s / self.memory.taus_s)).tolist()
        self.values = [own_degC, ambient_degC, power_on, *before]
        mean = [(before_degC + own_degC) / 2, ambient_degC, power_on, *before]
        self.memory.follow(self.values, mean, self._gained, _clipped)
        if self._unseen and not math.isnan(camera_degC):
            self._unseen = False
            self.settled_s = math.inf if abs(camera_degC - ambient_degC) < COLD_K else self.settled_s
        self.settled_s += dt_s
        self.on_s = self.on_s + dt_s if power_on == 1 else dt_s * power_on

    def _begin(self, ambient_degC, power_on, camera_degC):
        excess_K = 0.0 if math.isnan(camera_degC) else camera_degC - ambient_degC
        # Switched on as cold as the air, a camera was in equilibrium before: its state is known and no guess, so it has
        # no history flag (which 8 of 12 drawn cameras had for a whole session).
        cold = abs(excess_K) < COLD_K and not math.isnan(camera_degC)
        warmed = 0.0 if cold else min(max(excess_K / self._self_heating_K, 0.0), 1.0)
        self.begun = True
        self._unseen = power_on == 0 and math.isnan(camera_degC)
        self.settled_s = math.inf if cold else 0.0
        self.on_s = 0.0 if cold or power_on == 0 else math.inf
        self.values = self.memory.rest([ambient_degC + excess_K, float(ambient_degC), warmed])


def _clipped(value, low, high):
    return low if value < low else high if value > high else value


class Drift:
    """One camera and its thermal state."""

    def __init__(self, model):
        """model: what the JSON file holds; ValueError when numbers of it are none, or do not fit together."""
        if model.get("format") != "thermostand drift runtime" or model.get("version") != VERSION:
            raise ValueError("not a drift runtime model of this version; export the model again")
        _check(model)
        self._model = model
        self._coefficients = np.array(model["coefficients_px"])
        self._hull_px = np.array(model["hull_px"])
        self._camera_degC = math.nan
        terms = [expression_of(term) for term in model.get("terms", [])]
        self.ambient_lag = ("lag", ("air",), model.get("ambient_tau_s"))
        memory = remembered([*terms, self.ambient_lag]) if terms else ()
        self.state = ThermalState(memory, model.get("self_heating_K", math.nan))
        self._terms = [compiled(term, self.state.memory.at) for term in terms]

    @classmethod
    def load(cls, path):
        """The drift of a JSON file."""
        with open(path, encoding="utf-8") as file:
            return cls(json.load(file))

    @property
    def camera_serial(self):
        """Whose drift it is."""
        return self._model["camera_serial"]

    @property
    def image_size_px(self):
        """(width, height)."""
        return tuple(self._model["image_size_px"])

    @property
    def memory_s(self):
        """How long it must have been fed to be right, s; 0 for a form without memory."""
        return self._model.get("history_s", 0.0)

    def advance(self, dt_s, ambient_degC, power_on, camera_degC):
        """Advance the camera's thermal state, as ThermalState.advance does."""
        self.state.advance(dt_s, ambient_degC, power_on, camera_degC)
        measured = camera_degC if is_temperature(camera_degC) else math.nan
        self._camera_degC = self.state.camera_degC if self.state.begun else measured

    def shift(self, points_px):
        """Displacement (N, 2), px, of points (N, 2) to where they would be at the reference; NaN before `advance`."""
        points_px = np.asarray(points_px, float)
        if self._model["form"] == "paper":
            return self._polynomial(points_px) @ self._coefficients.T
        if not self.state.begun:
            return np.full_like(points_px, np.nan)
        amounts = self._coefficients @ self._away()
        return self._moved(points_px, amounts)

    def correct(self, points_px):
        """Return where the points (N, 2), px, would be at the reference."""
        return np.asarray(points_px, float) + self.shift(points_px)

    def intrinsics(self, k):
        """The camera matrix (3, 3) of this moment, of one that holds at the reference: what the drift makes of it at
        its principal point, to first order. [1, 0] is a turn about the optical axis. NaN where the state is unknown."""
        k = np.asarray(k, float)
        centre, step_px = k[:2, 2], 50.0
        places = centre + step_px * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        offset = source_offset(self.shift, places)
        grown = np.eye(3)
        grown[:2, 0] += (offset[1] - offset[2]) / (2 * step_px)
        grown[:2, 1] += (offset[3] - offset[4]) / (2 * step_px)
        grown[:2, 2] = centre + offset[0] - grown[:2, :2] @ centre
        return grown @ k

    def lattice(self):
        """Return where to read in the measured image, less the place itself: offsets (M, N, 2), px, at every 16th pixel
        of the corrected image in both directions, the last ones beyond it."""
        width, height = self._model["image_size_px"]
        at_x, at_y = (np.arange(0.0, size + LATTICE_PX, LATTICE_PX) for size in (width, height))
        places = np.stack(np.meshgrid(at_x, at_y), axis=-1)
        return source_offset(self.shift, places.reshape(-1, 2)).reshape(places.shape)

    def maps(self):
        """Return two float32 (height, width) for cv2.remap: where to read in the measured image for each pixel of the
        corrected one. NaN where the state is unknown: look at `flags`, and do not remap with it."""
        width, height = self._model["image_size_px"]
        lattice = self.lattice()
        offset = _between(_between(lattice, height, 0), width, 1)
        at_x = offset[:, :, 0] + np.arange(width)
        at_y = offset[:, :, 1] + np.arange(height)[:, None]
        return at_x.astype(np.float32), at_y.astype(np.float32)

    def flags(self, points_px):
        """(N,) int: why each correction is an extrapolation, 0 when it is not."""
        points_px = np.asarray(points_px, float)
        sides = np.roll(self._hull_px, -1, axis=0) - self._hull_px
        along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
        offset = points_px[:, None] - self._hull_px
        distance_px = along[:, 0] * offset[:, :, 1] - along[:, 1] * offset[:, :, 0]
        outside = ~(distance_px >= -HULL_MARGIN_PX).all(axis=1)
        return np.where(outside, PLACE, 0) | self._state_flags()

    def _polynomial(self, points_px):
        """The paper's terms: products of Chebyshev polynomials of I, J and T, each scaled to [-1, 1]."""
        width, height = self._model["image_size_px"]
        low, high = self._model["camera_range_degC"]
        t = np.full(len(points_px), (2 * self._camera_degC - low - high) / (high - low))
        i, j = 2 * (points_px[:, 0] + 0.5) / width - 1, 2 * (points_px[:, 1] + 0.5) / height - 1
        a, b, c = np.array(self._model["terms_abc"]).T
        chebyshev = [np.polynomial.chebyshev.chebvander(values, int(max(a))) for values in (i, j, t)]
        return chebyshev[0][:, a] * chebyshev[1][:, b] * chebyshev[2][:, c]

    def _away(self):
        """The terms of the thermal state minus those of the reference."""
        found = np.array([term(self.state.values) for term in self._terms])
        return found - np.array(self._model["reference_features"])

    def _moved(self, points_px, amounts):
        """Eight infinitesimal motions of a homography: shift, affine, perspective."""
        width, height = self._model["image_size_px"]
        x = (points_px[:, 0] - (width - 1) / 2) / (width / 2)
        y = (points_px[:, 1] - (height - 1) / 2) / (width / 2)
        right, down, xx, xy, yx, yy, bend_x, bend_y = amounts
        bend = bend_x * x + bend_y * y
        return np.stack([right + xx * x + xy * y + bend * x, down + yx * x + yy * y + bend * y], axis=1)

    def _state_flags(self):
        found = _beyond(self._camera_degC, self.limits("camera_range_degC"), CAMERA)
        if self._model["form"] == "paper":
            return found
        if not self.state.begun:
            return CAMERA | AMBIENT | SWITCHED_ON | HISTORY | STATE
        found |= _beyond(self.state.on_s, (self.least_on_s, math.inf), SWITCHED_ON)
        away, matrix = self._away(), np.array(self._model["leverage_matrix"])
        found |= _beyond(away @ matrix @ away, (0.0, self.most_leverage), STATE)
        ambient_degC = self.state.values[self.state.memory.at[self.ambient_lag]]
        found |= _beyond(ambient_degC, self.limits("ambient_range_degC"), AMBIENT)
        return found | _beyond(self.state.settled_s, (self.memory_s, math.inf), HISTORY)

    def limits(self, name):
        """A calibrated range (low, high) with its margin; the paper's form has none."""
        low, high = self._model[name]
        margin = 0.0 if self._model["form"] == "paper" else _MARGIN * (high - low)
        return low - margin, high + margin

    @property
    def least_on_s(self):
        """How long a camera must have been on, s; inf when none was switched on in the calibration."""
        least_s = self._model["least_on_s"]
        return math.inf if least_s is None else least_s - _SWITCHED_ON_S

    @property
    def most_leverage(self):
        """The largest leverage of a state that is still near the calibrated ones."""
        return _MORE_LEVERAGE * self._model["leverage"]


def _check(model):
    """ValueError that names the entry of the file."""
    paper = model.get("form") == "paper"
    count, size = len(model["terms_abc" if paper else "terms"]), model["image_size_px"]
    shapes = {"coefficients_px": (2 if paper else 8, count), "hull_px": (len(model["hull_px"]), 2)}
    shapes |= {"image_size_px": (2,), "camera_range_degC": (2,), "discrepancy_px": (2,)}
    if not paper:
        shapes |= {"reference_features": (count,), "leverage_matrix": (count, count), "ambient_range_degC": (2,)}
    for name in (name for name in shapes if name in model):
        try:
            found = np.array(model[name], float)
        except (TypeError, ValueError):
            raise ValueError(f"{name}: not numbers, as many in each row") from None
        if found.shape != shapes[name] or not np.isfinite(found).all():
            raise ValueError(f"{name}: not finite numbers of shape {shapes[name]}")
    if not 3 <= len(model["hull_px"]) <= MOST_CORNERS:
        raise ValueError(f"hull_px: {len(model['hull_px'])} corners, not 3 to {MOST_CORNERS}")
    terms_px = np.abs(np.array(model["coefficients_px"], float)).sum(axis=1).max(initial=0.0)
    if not (min(size) > 0 and terms_px <= MOST_IMAGES * max(size)):
        raise ValueError(f"coefficients_px: terms of {terms_px:.3g} px, for an image of {max(size)}")


def expression_of(value):
    """Build an expression from the lists of a JSON file; ValueError for what no expression has."""
    if isinstance(value, (list, tuple)):
        found = tuple(map(expression_of, value))
        if found[:1] in (("lag",), ("play",)) and (len(found) != 3 or not found[2] > 0):
            raise ValueError(f"terms: {value} has no time constant or radius above 0")
        return found
    if isinstance(value, str) or (isinstance(value, (int, float)) and math.isfinite(value)):
        return value
    raise ValueError(f"terms: {value} is no number")


def is_temperature(degC):
    """Return whether it can be one; NaN cannot."""
    return COLDEST_degC <= degC <= HOTTEST_degC


def source_offset(shift, xy_px):
    """Return where a point that is seen at (N, 2) px at the reference is in the measured image, less those points: the
    shift maps measured to reference, so it is inverted by fixed-point steps."""
    offset = np.zeros_like(xy_px)
    for _ in range(ROUNDS):
        offset = -shift(xy_px + offset)
    return offset


def _between(lattice, size, axis):
    """Linear between the lattice's values along an axis, at 0 .. size - 1."""
    cell, rest = np.divmod(np.arange(size), LATTICE_PX)
    share = (rest / LATTICE_PX).reshape([-1 if k == axis else 1 for k in range(3)])
    begin, end = np.take(lattice, cell, axis), np.take(lattice, cell + 1, axis)
    return begin + share * (end - begin)


def _beyond(value, limits, flag):
    return 0 if limits[0] <= value <= limits[1] else flag
