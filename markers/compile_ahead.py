"""The machine code of the markers' fits, compiled before the first image is looked at: an estimate of the time left
does not count what is done once per machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core.event import Listener, install_listener

from thermostand.markers.edge_fit import fit_edges
from thermostand.markers.edge_model import PARAMETERS, EdgeState
from thermostand.markers.noise import Noise
from thermostand.markers.pixels import make_picture
from thermostand.markers.refit import refit_edges


def compile_ahead(tell: Callable[[], None]) -> None:
    """Compile what is not kept on this machine; `tell` is called once before that, and not at all where all is kept."""
    picture = make_picture(np.zeros((8, 8), np.uint8))
    nothing, reach = EdgeState(np.empty((0, PARAMETERS)), np.empty(0)), np.empty((0, 2))
    with install_listener("numba:compile", _CompileListener(tell)):
        fit_edges(picture, nothing, Noise(), reach)
        refit_edges(picture, nothing, np.empty((0, 4)), Noise(), reach, tolerance=1.0, band_sigma=9.0)


class _CompileListener(Listener):
    """numba has begun to compile a function; each is made of many."""

    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell = tell
        self._is_reported = False

    def on_start(self, event: Any) -> None:
        if not self._is_reported:
            self._is_reported = True
            self._tell()

    def on_end(self, event: Any) -> None:
        pass
