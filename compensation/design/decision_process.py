"""The process in which a run decides on its next visit, see foundation/worker_process.py."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from thermostand.foundation.errors import StandError
from thermostand.foundation.worker_process import lower_priority

LEFT_NAME = "stand-known-left"  # of a process whose daemon has gone


def decide_next_visit(session: str, asked: Mapping[str, Any]) -> dict[str, Any]:
    """The decision about a session that is being recorded. asked: the parameters of the plan's step. kind: "visit",
    with chamber_degC and soak_s, "enough", or "none", when the frames so far allow no decision; reason: in words.
    Plain values: the daemon that reads them has nothing of this package."""
    import cv2

    from thermostand.compensation.design.next_visit import DesignGoal, decide, observe_partial_session
    from thermostand.experiments.steps import WANTED_STATES

    cv2.setNumThreads(1)
    wanted = DesignGoal(
        (asked["coldest_degC"], asked["warmest_degC"]),
        asked["residual_px"],
        tuple(asked.get("held_out_degC", ())),
        tuple(asked["soaks_s"]),
        asked["ramp_K_per_min"],
        tuple(asked.get("states", WANTED_STATES)),
    )
    try:
        found = decide(observe_partial_session(Path(session)), wanted)
    except (StandError, OSError) as error:
        return {"kind": "none", "reason": str(error)}
    except Exception as error:  # noqa: BLE001 - whatever it is, the fixed plan goes on
        return {"kind": "none", "reason": f"the drift model was not fitted ({type(error).__name__}: {error})"}
    return {
        "kind": found.kind,
        "reason": found.reason,
        "chamber_degC": float(found.chamber_degC),
        "soak_s": float(found.soak_s),
    }


def prepare() -> None:
    """Prepare the process that decides: one thread in each library, and a low priority."""
    for library in ("OMP", "OPENBLAS", "NUMBA"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
    lower_priority()
