"""The terms of the thermal model: how a homography moves points, times what the camera's thermal state makes of it.

A displacement field is a sum over the eight infinitesimal motions of a homography (shift, affine, perspective), each
with an amount that is linear in the features of the thermal state. Each kind of feature is described once, by its
class; another package adds one by a subclass of Term, which an entry point of the group `thermostand.drift_terms`
names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from itertools import product
from typing import Annotated, Any, ClassVar, cast

import numpy as np
from pydantic import Field, ValidationError

from thermostand.compensation.drift_runtime import compiled, remembered
from thermostand.compensation.expression import (
    AIR,
    CAMERA,
    Expression,
    Feature,
    Origin,
    away,
    backlash,
    format_words,
    lag,
)
from thermostand.compensation.history.thermal_history import Float, States, ThermalStateSpec
from thermostand.foundation.document_faults import format_path
from thermostand.foundation.documents import Document
from thermostand.foundation.plugins import load_point

GROUP = "thermostand.drift_terms"
MOTIONS = 8  # of a homography: shift (2), affine (4), perspective (2)
_QUICK_S = 240.0  # the quickest of the usual lags
# Slow lags have a width of their own: with one for all lags a sag was explained by coefficients of hours, and a colder
# start was wrong by 15 to 60 mpx (24 drawn cameras, numbers 3000 on).
_SLOW_S = 12600.0
"""Lags from here on are slower than a camera warms: of what creeps, which most cameras have little of."""

Tau_s = Annotated[float, Field(gt=0, le=1e9)]
Radius_K = Annotated[float, Field(gt=0, le=1e3)]
Share = Annotated[float, Field(ge=0, le=1)]

TERMS: dict[str, type[Term]] = {}
"""Every kind of term that is known, by its name, in the order of a fit's features."""


class Term(Document):
    """A feature of the drift, and all facts about its kind; fields are its parameters, with units.

    kind: its name in model files. title: its name in a model's, where the first field's range stands behind it.
    """

    kind: ClassVar[str]
    title: ClassVar[str] = ""

    @classmethod
    def __pydantic_init_subclass__(cls, **given: Any) -> None:
        if "kind" not in vars(cls):
            raise TypeError(f"{cls.__name__} is a term and has to state its kind")
        cls.title = vars(cls).get("title", cls.kind)
        TERMS[cls.kind] = cls

    @property
    def feature(self) -> Feature:
        """What it is of the thermal state: near 0 in equilibrium at the reference, and about 1 where it is large."""
        raise NotImplementedError

    @property
    def width(self) -> str:
        """Terms of one width have coefficients of one size."""
        return self.kind

    @property
    def symbol(self) -> str:
        """The symbol of its feature in a formula."""
        return format_words(self.feature)

    @classmethod
    def usual(cls) -> Sequence[Term]:
        """The terms that every fit has; the data decide how much each counts."""
        return (cls(),)


class ConstantTerm(Term):
    """The misfit at the reference."""

    kind = "constant"

    @property
    def feature(self) -> Feature:
        return 1.0


class CameraTerm(Term):
    """The camera's own temperature, which brings its self-heating with it: with lags of the supply instead, a warm-up
    in other air is predicted worse."""

    kind = "camera"

    @property
    def feature(self) -> Feature:
        return away(CAMERA)


class CameraSquaredTerm(Term):
    """The square of the camera's temperature."""

    kind = "camera squared"

    @property
    def feature(self) -> Feature:
        return away(CAMERA) ** 2


class AmbientLag(Term):
    """A part that follows the air late."""

    kind = "ambient lag"
    of: ClassVar[Expression] = AIR
    tau_s: Tau_s

    @property
    def feature(self) -> Feature:
        return away(lag(self.of, self.tau_s))

    @property
    def width(self) -> str:
        return f"{self.kind}, slow" if self.tau_s >= _SLOW_S else self.kind

    @classmethod
    def usual(cls) -> Sequence[Term]:
        """The slowest are for what creeps, and for a session that begins before all is warm; lags between two of these
        are sums of them."""
        # Eight do what fifteen did on 16 drawn cameras. Reaching 450 min lowered the median from 3.3 to 2.0 mpx, the
        # worst from 32 to 17 and what creeps from 7.3 to 2.2. They lie within a factor of about two of each other.
        return tuple(cls(tau_s=60.0 * minutes) for minutes in (4, 8, 15, 27, 50, 100, 210, 450))


class CameraLag(AmbientLag):
    """A part that follows the camera's own temperature late, as a lens does."""

    kind = "camera lag"
    of = CAMERA


class AmbientLagSquared(Term):
    """Higher powers follow the air: a camera that is switched on cold is at temperatures of its own that a warm one
    reaches in much colder air only, and powers of these would extrapolate there."""

    kind = "ambient lag squared"
    power: ClassVar[int] = 2
    tau_s: Tau_s

    @property
    def feature(self) -> Feature:
        return away(lag(AIR, self.tau_s)) ** self.power

    @property
    def width(self) -> str:
        return "ambient lag bent"

    @classmethod
    def usual(cls) -> Sequence[Term]:
        # Squares and cubes of three lags of the air, with one width: switching on, small steps and jumps left 4.3, 3.6
        # and 4.7 mpx for 6.7, 7.7 and 6.5 (24 drawn cameras, 3000 on). Cubes of the camera's own temperature left up to
        # 95.
        return tuple(cls(tau_s=tau_s) for tau_s in (480.0, 1620.0, 6000.0))


class AmbientLagCubed(AmbientLagSquared):
    """The cube of a lag of the air."""

    kind = "ambient lag cubed"
    power = 3


class BacklashTerm(Term):
    """A dead zone in what follows the camera's temperature."""

    kind = "play"
    title = "plays"
    radius_K: Radius_K

    @property
    def feature(self) -> Feature:
        return away(backlash(CAMERA, self.radius_K))

    @classmethod
    def usual(cls) -> Sequence[Term]:
        return tuple(cls(radius_K=radius_K) for radius_K in (3.0, 6.0, 10.0, 14.0))


class HiddenBacklashTerm(Term):
    """The backlash of a part between air and camera that nobody measures, as a mount: it follows both late, and has a
    share of the camera's excess over the air. A dead zone in a mount moves the image by where the mount came from,
    which is no play of the chip's temperature: switching on heats the chip by 15 K and the mount by 3."""

    kind = "part play"
    title = "plays of parts"
    radius_K: Radius_K
    tau_s: Tau_s
    share: Share

    @property
    def feature(self) -> Feature:
        air, camera = lag(AIR, self.tau_s), lag(CAMERA, self.tau_s)
        return away(backlash(air + self.share * (camera - air), self.radius_K))

    @property
    def symbol(self) -> str:
        return f"play({self.radius_K:g} K, {self.tau_s / 60:g} min, {self.share:g})"

    @classmethod
    def usual(cls) -> Sequence[Term]:
        # Chosen on simulated presets 300 to 303 and drawn cameras 6000 on: small steps leave 5.4 mpx for 10.8, jumps
        # 8.0 for 14.4. Radii up to 6 K, shares of 0 or 0.3 alone, and lags to 100 min gained less.
        parts = product((480.0, 1620.0, 3000.0), (0.1, 0.3), (1.0, 2.0, 4.0))
        return tuple(cls(radius_K=radius_K, tau_s=tau_s, share=share) for tau_s, share, radius_K in parts)


def list_usual_terms() -> tuple[Term, ...]:
    """Return what a camera may be moved by: the terms of a fit. ConfigError where a package's cannot be loaded."""
    for point in entry_points(group=GROUP):
        load_point(point)
    return tuple(term for kind in TERMS.values() for term in kind.usual())


def parse_term(value: object) -> Term:
    """The term of a model file; ValueError when there is none such."""
    if isinstance(value, Term):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("not a term: give its kind and parameters")
    given = dict(cast("Mapping[str, Any]", value))
    kind = given.pop("kind", None)
    if kind not in TERMS:
        for point in entry_points(group=GROUP, name=str(kind)):
            load_point(point)
    if kind not in TERMS:
        raise ValueError(f"no model has a {kind}; there are {', '.join(TERMS)}")
    try:
        return TERMS[kind].model_validate(given)
    except ValidationError as error:
        raise ValueError("; ".join(f"{format_path(each['loc'])}: {each['msg']}" for each in error.errors())) from error


def build_state_spec(terms: Sequence[Term], self_heating_K: float) -> ThermalStateSpec:
    """Return what the terms need remembered, and a lag of the ambient in any case: its range is part of where a model
    holds, also where a warm-up has shown the camera at every temperature."""
    parts = remembered([term.feature for term in terms])
    quickest = () if any(part[:2] == ("lag", AIR) for part in parts) else (lag(AIR, _QUICK_S),)
    return ThermalStateSpec((*parts, *quickest), self_heating_K)


def compute_features(states: States, these: Sequence[Feature], origin: Origin) -> Float:
    """(F, H) of F instants and H features; all but the constant are near 0 in equilibrium at the reference."""
    count, columns = len(states.camera_degC), states.columns
    values = [compiled(origin.bind(one), states.memory.at)(columns) for one in these]
    return np.stack([np.broadcast_to(np.asarray(one, np.float64), count) for one in values], axis=1)


def compute_motions(xy_px: Float, image_size: tuple[int, int]) -> Float:
    """(N, 2, 8): what each motion does to points (N, 2), per unit of amount, px."""
    width, height = image_size
    x = (xy_px[:, 0] - (width - 1) / 2) / (width / 2)
    y = (xy_px[:, 1] - (height - 1) / 2) / (width / 2)
    one, zero = np.ones_like(x), np.zeros_like(x)
    along_i = [one, zero, x, y, zero, zero, x * x, x * y]
    along_j = [zero, one, zero, zero, x, y, x * y, y * y]
    return np.stack([np.stack(along_i, axis=-1), np.stack(along_j, axis=-1)], axis=1)
