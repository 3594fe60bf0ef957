"""The thermal states in which a model is wanted, of which a night predicts what it will leave there."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from thermostand.compensation.design.forecast import Situation, Surroundings, after, at_rest, together
from thermostand.compensation.history.states import Memory
from thermostand.experiments.steps import WantedState

_PLACES = 7
_AFTER_S: dict[WantedState, float] = {"at_rest": 4 * 3600.0, "on_the_way": 2700.0}


def wanted_states(
    around: Surroundings, memory: Memory, range_degC: tuple[float, float], kinds: Sequence[WantedState]
) -> Situation:
    """Of a powered camera throughout the range: so long after it was brought there from rest in the middle, or half way
    to either end. Both ways to a temperature and what creeps are in these. ValueError without a kind."""
    low, high = range_degC
    pairs = np.array(list(product(np.linspace(low, high, 5)[1:4], np.linspace(low, high, _PLACES))))
    begun = at_rest(around, pairs[:, 0], memory)
    return together([after(around, begun, pairs[:, 1], np.full(len(pairs), _AFTER_S[kind])) for kind in kinds])
