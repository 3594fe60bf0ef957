"""What a drift term is written in: a small expression of the camera's thermal state, one form for everything that is
made of it. drift_runtime.py works it out, in a run-time, a fit and a forecast; here it is written in C and in a report.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from thermostand.compensation.drift_runtime import INPUTS, compiled

SPAN_K = 20.0
"""Temperatures are scaled by this, so that all features are about 1."""


class Expression(tuple[Any, ...]):
    """(operation, of, ...), as drift_runtime.compiled takes it, and a JSON file after `bound`; operands are expressions
    and numbers. `away` is what is left of a temperature in equilibrium at the reference, in units of SPAN_K."""

    __slots__ = ()

    def __add__(self, other: object) -> Expression:
        return Expression(("+", self, other))

    def __sub__(self, other: object) -> Expression:
        return Expression(("-", self, other))

    def __mul__(self, other: object) -> Expression:
        return Expression(("*", self, other))

    def __rmul__(self, other: object) -> Expression:
        return Expression(("*", other, self))

    def __truediv__(self, other: object) -> Expression:
        return Expression(("/", self, other))

    def __pow__(self, power: int) -> Expression:
        return Expression(("**", self, power))


Feature = Expression | float
CAMERA, AIR, POWER = map(Expression, INPUTS)


def lag(of: Expression, tau_s: float) -> Expression:
    """A first-order follower with this time constant, s, above 0."""
    return Expression(("lag", of, tau_s))


def backlash(of: Expression, radius_K: float) -> Expression:
    """A dead zone of this radius, above 0."""
    return Expression(("play", of, radius_K))


def away(of: Expression) -> Expression:
    """A temperature, less what it is in equilibrium at the reference, over SPAN_K."""
    return Expression(("away", of))


@dataclass(frozen=True, slots=True)
class Origin:
    """Temperatures at the reference: of the camera and of the air near it."""

    camera_degC: float
    ambient_degC: float

    def bind(self, feature: Feature) -> Feature:
        """The feature with numbers in place of what is `away` from the reference."""
        if not isinstance(feature, tuple):
            return feature
        if feature[0] == "away":
            return (self.bind(feature[1]) - self.evaluate_at_rest(feature[1])) / SPAN_K
        return Expression((feature[0], *map(self.bind, feature[1:]))) if feature not in INPUTS else feature

    def evaluate_at_rest(self, feature: Any) -> float:
        """Return what a feature without `away` is in equilibrium at the reference, of a camera that is on."""
        if isinstance(feature, tuple) and feature[0] in ("lag", "play"):
            return self.evaluate_at_rest(feature[1])
        if not isinstance(feature, tuple) or feature in INPUTS:
            inputs = (self.camera_degC, self.ambient_degC, 1.0)
            return compiled(feature, {one: place for place, one in enumerate(INPUTS)})(inputs)
        parts = [self.evaluate_at_rest(part) for part in feature[1:]]
        return compiled((feature[0], *parts), {})(())


_PRECEDENCE = {"+": 1, "-": 1, "*": 2, "/": 2, "**": 3}


def format_c(feature: Feature, at: Mapping[Any, str]) -> str:
    """A C expression of doubles; at: how inputs, lags and plays are written."""
    if not isinstance(feature, tuple):
        return repr(float(feature))
    if feature in at:
        return at[feature]
    operation, one, other = feature
    if operation == "**":
        return "(" + " * ".join([format_c(one, at)] * other) + ")"
    return f"({format_c(one, at)} {operation} {format_c(other, at)})"


_LETTERS = {INPUTS[0]: "T", INPUTS[1]: "air", INPUTS[2]: "supply"}
_LAGGED = {INPUTS[0]: "camera", INPUTS[1]: "air", INPUTS[2]: "supply"}


def format_words(feature: Feature) -> str:
    """Write the expression as the formula of a report has it: air(8 min)^2, play(3 K); what is `away` is called as what
    it is of."""
    if not isinstance(feature, tuple):
        return f"{feature:g}"
    match feature:
        case ("away", of):
            return format_words(of)
        case ("lag", of, tau_s):
            within = "" if of in _LAGGED else f"{format_words(of)}, "
            return f"{_LAGGED.get(of, 'lag')}({within}{tau_s / 60:g} min)"
        case ("play", of, radius_K):
            within = "" if of == CAMERA else f"{format_words(of)}, "
            return f"play({within}{radius_K:g} K)"
        case ("**", of, power):
            return f"{_bracket(of, 3)}^{power}"
        case ("*", one, other):
            return f"{_bracket(one, 2)} {_bracket(other, 2)}"
        case (operation, one, other):
            level = _PRECEDENCE[operation]
            return f"{_bracket(one, level)} {operation} {_bracket(other, level + 1)}"
        case _:
            return _LETTERS[feature]


def _bracket(feature: Any, level: int) -> str:
    """Put a feature in brackets where it binds less than what is around it."""
    text = format_words(feature)
    while isinstance(feature, Expression) and feature[0] == "away":
        feature = feature[1]
    return f"({text})" if isinstance(feature, Expression) and _PRECEDENCE.get(feature[0], 4) < level else text
