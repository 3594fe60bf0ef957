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

VERSION = 3
"""Of the JSON file. From thermostand 0.2.0 on each version reads the files of all before it."""

RATE_TAU_S = 600.0
"""The ambient's rate of change is that of its 10 min lag."""
SETTLED_TAUS = 3.0
"""After so many time constants a state that began with a guess has forgotten it (5 % are left)."""
COLD_K = 3.0
"""A camera this close to the air around it has been off for long: nothing of it is warm."""
UNPOWERED_TAU_S = 900.0
"""An unpowered camera reports no temperature; its excess over the air is assumed to decay so until it does."""
SPAN_K, HULL_MARGIN_PX = 20.0, 1.0
COLDEST_degC, HOTTEST_degC = -273.15, 1000.0
MOST_CORNERS = 2000
"""Of a hull: that of a night's markers has about 40. Each point is compared with each corner."""
MOST_IMAGES = 1000
"""The terms of a correction are not larger in all: those of a fit to few temperatures cancel each other, and of a table
of centres they were five images."""
LATTICE_PX, ROUNDS = 16, 4
"""Maps are worked out every 16 px; the shift changes by some 1e-4 px per px, and each round of its inverse gains four
digits."""
_MARGIN, _SWITCHED_ON_S, _MORE_LEVERAGE = 0.02, 1.0, 3.0


class ThermalState:
    """The thermal state of one camera, followed from sample to sample.

    It begins, and begins again after a gap, in equilibrium: lags of temperatures at these temperatures, lags of the
    power at the part of its self-heating that the camera shows. Unless the camera is as cold as the air when it is
    first seen, or when it is switched on after it was unpowered until then, that is a guess, which is forgotten after
    about three of the time constants. camera_degC, air_degC: the last ones.
    ambient_lag, power_lag, camera_lag: the 10 min lag, then one for each of taus_s. plays: one for each of plays_K,
    then one for each of part_plays.
    settled_s: how long ago the state was a guess. on_s: since the camera was switched on. begun: False in a gap.
    """

    def __init__(self, taus_s, plays_K, self_heating_K, part_plays=()):
        """taus_s: time constants, s. plays_K: radii. self_heating_K: over the air of a camera that has been on for
        long. part_plays: (time constant of taus_s, share, radius) of parts between air and camera, which follow both
        late and have that share (0..1) of the camera's excess."""
        self._taus_s = np.array([RATE_TAU_S, *taus_s])
        self._radii_K = [float(radius_K) for radius_K in (*plays_K, *(part[2] for part in part_plays))]
        self._parts = [(1 + list(taus_s).index(tau_s), float(share)) for tau_s, share, _ in part_plays]
        self._self_heating_K = self_heating_K
        self._dt_s = self._gained = math.nan
        self.begun = self._unseen = False
        self.settled_s = self.on_s = self.air_degC = self.camera_degC = math.nan
        # Lists: for so few numbers numpy takes three times as long.
        self._ambient = self._power = self._camera = [math.nan] * len(self._taus_s)
        self._plays = [math.nan] * len(self._radii_K)

    @property
    def ambient_lag(self):
        """(1 + K,)."""
        return np.array(self._ambient)

    @property
    def power_lag(self):
        """(1 + K,)."""
        return np.array(self._power)

    @property
    def camera_lag(self):
        """(1 + K,)."""
        return np.array(self._camera)

    @property
    def plays(self):
        """(P,)."""
        return np.array(self._plays)

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
        before_degC = self.camera_degC
        excess_K = (before_degC - self.air_degC) * math.exp(-dt_s / UNPOWERED_TAU_S)
        self.air_degC = ambient_degC
        self.camera_degC = ambient_degC + excess_K if math.isnan(camera_degC) else camera_degC
        # First-order followers of a constant input, exactly: z + (s - z)(1 - exp(-dt/tau)); and Prandtl-Ishlinskii
        # plays, which stay where they are until the camera is further away than their radius.
        if dt_s != self._dt_s:
            self._dt_s, self._gained = dt_s, (-np.expm1(-dt_s / self._taus_s)).tolist()
        self._ambient = _followed(self._ambient, ambient_degC, self._gained)
        self._power = _followed(self._power, power_on, self._gained)
        self._camera = _followed(self._camera, (before_degC + self.camera_degC) / 2, self._gained)
        self._plays = [
            low if play < low else high if play > high else play
            for play, push_degC, radius_K in zip(self._plays, self._pushes(), self._radii_K, strict=True)
            for low, high in ((push_degC - radius_K, push_degC + radius_K),)
        ]
        if self._unseen and not math.isnan(camera_degC):
            self._unseen = False
            self.settled_s = math.inf if abs(camera_degC - ambient_degC) < COLD_K else self.settled_s
        self.settled_s += dt_s
        self.on_s = self.on_s + dt_s if power_on == 1 else dt_s * power_on

    @property
    def rate_K_per_h(self):
        """How fast the ambient changes."""
        return 3600 / RATE_TAU_S * (self.air_degC - self._ambient[0])

    def _begin(self, ambient_degC, power_on, camera_degC):
        excess_K = 0.0 if math.isnan(camera_degC) else camera_degC - ambient_degC
        cold = abs(excess_K) < COLD_K and not math.isnan(camera_degC)
        warmed = 0.0 if cold else min(max(excess_K / self._self_heating_K, 0.0), 1.0)
        self.begun = True
        self._unseen = power_on == 0 and math.isnan(camera_degC)
        self.settled_s = math.inf if cold else 0.0
        self.on_s = 0.0 if cold or power_on == 0 else math.inf
        self.air_degC, self.camera_degC = ambient_degC, ambient_degC + excess_K
        self._ambient, self._power, self._camera = (
            [float(at)] * len(self._taus_s) for at in (ambient_degC, warmed, self.camera_degC)
        )
        self._plays = self._pushes()

    def _pushes(self):
        """What moves each play: the camera, or a part."""
        ambient, camera = self._ambient, self._camera
        parts = [ambient[at] + share * (camera[at] - ambient[at]) for at, share in self._parts]
        return [self.camera_degC] * (len(self._radii_K) - len(parts)) + parts


def _followed(lags, value, gained):
    return [lag + (value - lag) * part for lag, part in zip(lags, gained, strict=True)]


class Drift:
    """One camera and its thermal state."""

    def __init__(self, model):
        """model: what the JSON file holds; ValueError when numbers of it are none, or do not fit together."""
        if model.get("format") != "thermostand drift runtime" or model.get("version") != VERSION:
            raise ValueError("not a drift runtime model of this version; export the model anew")
        _check(model)
        self._model = model
        self._coefficients = np.array(model["coefficients_px"])
        self._hull_px = np.array(model["hull_px"])
        self._state = ThermalState(
            model.get("taus_s", []),
            model.get("plays_K", []),
            model.get("self_heating_K", math.nan),
            model.get("part_plays", []),
        )
        self._camera_degC = math.nan

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
        """As ThermalState.advance."""
        self._state.advance(dt_s, ambient_degC, power_on, camera_degC)
        measured = camera_degC if is_temperature(camera_degC) else math.nan
        self._camera_degC = self._state.camera_degC if self._state.begun else measured

    def shift(self, points_px):
        """Displacement (N, 2), px, of points (N, 2) to where they would be at the reference; NaN before `advance`."""
        points_px = np.asarray(points_px, float)
        if self._model["form"] == "paper":
            return self._polynomial(points_px) @ self._coefficients.T
        if not self._state.begun:
            return np.full_like(points_px, np.nan)
        amounts = self._coefficients @ self._away()
        return self._moved(points_px, amounts)

    def correct(self, points_px):
        """Where the points (N, 2), px, would be at the reference."""
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
        """Where to read in the measured image, less the place itself: offsets (M, N, 2), px, at every 16th pixel of the
        corrected image in both directions, the last ones beyond it."""
        width, height = self._model["image_size_px"]
        at_x, at_y = (np.arange(0.0, size + LATTICE_PX, LATTICE_PX) for size in (width, height))
        places = np.stack(np.meshgrid(at_x, at_y), axis=-1)
        return source_offset(self.shift, places.reshape(-1, 2)).reshape(places.shape)

    def maps(self):
        """Two float32 (height, width) for cv2.remap: where to read in the measured image for each pixel of the
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

    def _features(self):
        """The terms of the thermal state."""
        camera_degC, air_degC = self._model["reference_degC"], self._model["reference_ambient_degC"]
        taus_s, radii_K = self._model["taus_s"], self._model["plays_K"]
        parts = [tuple(part) for part in self._model["part_plays"]]
        state, own = self._state, (self._state.camera_degC - camera_degC) / SPAN_K
        values = []
        for kind, parameter, *of_part in self._model["terms"]:
            if of_part:
                place_degC = state.plays[len(radii_K) + parts.index((*of_part, parameter))]
                values.append((place_degC - air_degC - of_part[1] * (camera_degC - air_degC)) / SPAN_K)
                continue
            at = 1 + taus_s.index(parameter) if parameter in taus_s else 0
            values.append(
                {
                    "constant": lambda: 1.0,
                    "camera": lambda: own,
                    "camera squared": lambda: own**2,
                    "ambient lag": lambda at=at: (state.ambient_lag[at] - air_degC) / SPAN_K,
                    "ambient lag squared": lambda at=at: ((state.ambient_lag[at] - air_degC) / SPAN_K) ** 2,
                    "ambient lag cubed": lambda at=at: ((state.ambient_lag[at] - air_degC) / SPAN_K) ** 3,
                    "camera lag": lambda at=at: (state.camera_lag[at] - camera_degC) / SPAN_K,
                    "play": lambda r=parameter: (state.plays[radii_K.index(r)] - camera_degC) / SPAN_K,
                }[kind]()
            )
        return np.array(values)

    def _away(self):
        """The features minus those of the reference."""
        return self._features() - np.array(self._model["reference_features"])

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
        if not self._state.begun:
            return CAMERA | AMBIENT | SWITCHED_ON | HISTORY | STATE
        found |= _beyond(self._state.on_s, (self.least_on_s, math.inf), SWITCHED_ON)
        away, matrix = self._away(), np.array(self._model["leverage_matrix"])
        found |= _beyond(away @ matrix @ away, (0.0, self.most_leverage), STATE)
        if self._model["taus_s"]:
            found |= _beyond(self._state.ambient_lag[1], self.limits("ambient_range_degC"), AMBIENT)
        return found | _beyond(self._state.settled_s, (self.memory_s, math.inf), HISTORY)

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
        """Of a state that is still near the calibrated ones."""
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


def is_temperature(degC):
    """Whether it can be one; NaN cannot."""
    return COLDEST_degC <= degC <= HOTTEST_degC


def source_offset(shift, xy_px):
    """Where a point that is seen at (N, 2) px at the reference is in the measured image, less those points: the shift
    maps measured to reference, so it is inverted by fixed-point steps."""
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
