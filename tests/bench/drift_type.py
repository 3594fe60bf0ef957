"""A new unit of a camera type, seen at two temperatures, with what six other units have shown: on another night."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tests.bench.drift_drawn import effects_of, score
from tests.bench.figures import Figure, absolute, at_least, progress, ratio_at_most, side_by_side
from tests.compensation.drawn_cameras import drawn_unit
from tests.compensation.drawn_nights import cycle, full_night, night, reference, warm_up
from thermostand.compensation.drift.anchoring import fit_like
from thermostand.compensation.drift.thermal_learning import fit_thermal
from thermostand.experiments.steps import Role

TYPES, FIRST, UNITS, NEW = 10, 7800, 6, 99
SEEN_DEGC = (45,)
ASKED_DEGC = (31, 41, 48, 41, 31, 20, 14, 20)
GOAL, LEAST_COVERED = 1.5, 92


def figures() -> Iterator[Figure]:
    """What is left, beside a model of the unit's own whole night, and how often the 95 % interval holds."""
    progress(f"drift, new units of {TYPES} drawn types")
    left, whole, covered = [], [], []
    for seed in range(FIRST, FIRST + TYPES):
        effects = effects_of(seed, unrepeating=False)[0]
        units = [fit_thermal(night(drawn_unit(seed, k, *effects), full_night(), k).observed) for k in range(UNITS)]
        new, begin = drawn_unit(seed, NEW, *effects), [*warm_up(), *reference()]
        asked = night(new, [*begin, *cycle(ASKED_DEGC, ASKED_DEGC)], NEW + 200, session_id="night-2")
        few = fit_like(night(new, [*begin, *cycle(SEEN_DEGC, ())], NEW + 100).observed, units)
        found = score(few, asked, Role.VALIDATION)
        left.append(found.rms_mpx)
        covered.append(100 * found.covered)
        whole.append(score(fit_thermal(night(new, full_night(), NEW).observed), asked, Role.VALIDATION).rms_mpx)
    what = "drift, a new unit of a known type from two temperatures"
    yield ratio_at_most(GOAL, side_by_side(what, "mpx RMS", "its whole night", left, whole))
    held = absolute("  95 % interval", "%", [float(np.mean(covered))])
    yield at_least(LEAST_COVERED, held)
