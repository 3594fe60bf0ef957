"""The drift models on whole recorded sessions of the simulated stand, against its noise-free truth.

`pytest -m nightly -s` prints the figures.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import evaluate
from thermostand.compensation.drift.model_selection import fit
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.observations import Observations, observe
from thermostand.experiments.steps import Role
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item
from thermostand.foundation.progress import progress
from thermostand.foundation.readings import Frame
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

pytestmark = pytest.mark.nightly

Seen = tuple[Observations, NDArray[np.float64]]

RECIPE = """
name: night
experiments:
  - warm_up: {table_position: {linear: 0, rotary: 0}, cool_down_max_s: 5400, frames: 60, interval_s: 30}
  - thermal_cycle:
      table_position: {linear: 0, rotary: 0}
      set_points_degC: [31, 34, 38, 45, 48, 52, 48, 45, 38, 34, 31, 24, 20, 17, 10, 17, 20, 24]
      held_out_degC: [20, 34, 48]
      soak_s: 2700
      reference_frames: 20
      frames_per_point: 5
"""
WARM_UP = """
name: elsewhere
experiments:
  - warm_up:
      {table_position: {linear: 0, rotary: 0}, chamber_degC: %g, cool_down_max_s: 7200, frames: 60, interval_s: 30}
"""

# RMS of both coordinates, mpx. Measured for the modified camera: 1.7 at held-out temperatures, 3.3 and 6.7 in the
# warm-ups at 15 and 34 degC.
HELD_OUT_MPX = {"modified": 5.0, "unmodified": 15.0}
# The goal in warm-ups is 3 mpx, and it is missed. This is one session of one camera, on which the form before had left
# 1.8 and 3.5; over four sessions (`python -m tests.bench drift`) it had left 10.4 and 4.5 where this one leaves 6.1 and
# 5.3. So the bounds here say that a recorded session comes to what the form can do, and the bench whether that is
# enough.
WARM_UP_MPX = {15.0: 6.0, 34.0: 8.0}
OF_PAPERS_FORM = 0.2  # at most so much of what the paper's form leaves
# What the model and the markers claim, over what is left, RMS. No upper limit of the coverage: three temperatures of
# one camera share their errors, so of intervals that are right most sessions hold more than 98 %, and some far fewer
# than 92. Measured: 1.5 and 1.4, with 99.7 and 99.6 % held. `make bench` shows the coverage over many cameras.
WIDEST = 2.0


async def record(order: Order, out: Path) -> Seen:
    """Run, asking the simulated laboratory for the true centres at each frame."""
    assert order.config.simulation is not None
    host, port = order.config.simulation.control.removeprefix("tcp:").rsplit(":", 1)
    truth: list[object] = []

    def look(item: Item) -> None:
        if isinstance(item, Frame):
            with socket.create_connection((host, int(port)), 5.0) as link, link.makefile("rw") as lines:
                lines.write('{"do": "optics"}\n')
                lines.flush()
                truth.append(json.loads(lines.readline())["centres_px"])

    def watch(hub: Hub) -> None:
        hub.subscribe(look)

    path = await run_virtual(order, out, 1, watch)
    return observe([path], progress), np.array(truth)


def left_mpx(model: DriftModel, seen: Seen, role: Role, reference_px: NDArray[np.float64]) -> float:
    observed, truth_px = seen
    states = compute_frame_states(observed, model.memory)
    frames = np.flatnonzero(observed.of(role)).tolist()
    left = [reference_px - model.correct(truth_px[k], states.where(np.array([k]))) for k in frames]
    return 1e3 * float(np.sqrt(np.mean(np.square(left))))


async def test_the_modified_camera_is_compensated_at_unseen_temperatures_and_in_unseen_warm_ups(
    tmp_path: Path, order: Callable[..., Order]
):
    session = await record(order(RECIPE), tmp_path / "cycle")
    reference_px = session[1][session[0].of(Role.REFERENCE)].mean(axis=0)
    model = fit(session[0])
    assert model.form == "thermal"
    paper = fit(session[0], form="paper")
    asked = [(session, Role.VALIDATION, HELD_OUT_MPX["modified"])]
    for air_degC, most_mpx in WARM_UP_MPX.items():
        elsewhere = await record(order(WARM_UP % air_degC), tmp_path / f"{air_degC:g}")
        asked.append((elsewhere, Role.WARM_UP, most_mpx))
    left = [[left_mpx(form, seen, role, reference_px) for form in (model, paper)] for seen, role, _ in asked]
    found = evaluate(model, session[0])
    width = np.sqrt(np.mean(found.claimed_px2, axis=0) / np.mean(found.after_px**2, axis=0))
    print(left, found.coverage_95, width)  # noqa: T201
    for (own_mpx, papers_mpx), (*_, most_mpx) in zip(left, asked, strict=True):
        assert own_mpx <= min(most_mpx, OF_PAPERS_FORM * papers_mpx), left
    assert min(found.coverage_95) >= 0.92
    assert width.max() <= WIDEST


async def test_the_unmodified_camera_is_compensated_at_unseen_temperatures(tmp_path: Path, order: Callable[..., Order]):
    session = await record(order(RECIPE, simulation={"camera": "unmodified"}), tmp_path / "cycle")
    reference_px = session[1][session[0].of(Role.REFERENCE)].mean(axis=0)
    model = fit(session[0])
    assert model.form == "thermal"
    own_mpx = left_mpx(model, session, Role.VALIDATION, reference_px)
    print(own_mpx)  # noqa: T201
    assert own_mpx <= HELD_OUT_MPX["unmodified"]
