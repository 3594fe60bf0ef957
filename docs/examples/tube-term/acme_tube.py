"""A term of the drift model: a tube that is warm at the camera's end."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from thermostand.compensation.drift.terms import Term
from thermostand.compensation.expression import AIR, CAMERA, POWER, Feature, away, lag


class Gradient(Term):
    """A lag of a lag of the camera, less a lag of the air, times how long the camera has been on."""

    kind = "tube gradient"
    tau_s: Annotated[float, Field(gt=0)]

    @property
    def feature(self) -> Feature:
        """One expression. Fit, formula, Python run-time, C header and forecast follow from it."""
        return away(lag(lag(CAMERA, self.tau_s), 300.0) - lag(AIR, self.tau_s)) * lag(POWER, 1200.0)

    @classmethod
    def usual(cls) -> Sequence[Term]:
        """Return the terms that every fit tries."""
        return (cls(tau_s=700.0), cls(tau_s=2000.0))
