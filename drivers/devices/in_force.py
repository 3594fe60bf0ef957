"""Whether the set-point that was written is the one that acts: what a controller says of it.

A value can be written and read back and yet not be what the unit goes to: another set-point bank, a remote set-point, a
sensor outside, a program, a ramp, an operator at the panel, degrees Fahrenheit.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class InForce:
    """known_by: the registers or queries that tell it; "" when none does. not_told: what they leave open; "" for
    nothing. objections: a sentence for each thing that acts in its place, with what to do; () while it is in force."""

    known_by: str
    not_told: str = ""
    objections: tuple[str, ...] = ()
