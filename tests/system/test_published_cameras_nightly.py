"""Sessions of the simulated laboratory with each camera of configs/optics, through every wire: recorded to the end, and
the image grows or shrinks as its file says."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
import yaml

from thermostand.compensation.observations import Observations, observe
from thermostand.experiments.steps import Role
from thermostand.foundation.documents import parse_document
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

from .conftest import require_aravis

RECIPE = """
name: up
experiments:
  - thermal_cycle: {table_position: {linear: 0, rotary: 0}, reference_degC: 24, equilibrium_s: 3600,
                    set_points_degC: [31, 38], soak_s: 3600, reference_frames: 2, frames_per_point: 2}
"""
EFFECTS = ["sag", "dead_zone", "creep", "stick_slip", "unrepeated", "coarse_sensor", "far_air"]


def recorded(optics: str, out: Path) -> Observations:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["simulation"]["cameras"] = {"camera": {"optics": optics, "effects": EFFECTS, "drawn": 3}}
    data["guard"]["camera_crosscheck"] = {"settle_s": 14400, "limit_K": 12}  # of a camera that nobody has measured
    data["chamber"] = {"camera_lag_s": 2000}
    text = yaml.safe_dump(data)
    config, recipe = parse_document(text, StandConfig, "config"), parse_document(RECIPE, Recipe, "recipe")
    order = Order(config, recipe, text, RECIPE, find_packaged("targets", "paper-9x6").read_text())
    return observe(asyncio.run(run_virtual(order, out, 1, lambda _: None)))


@pytest.mark.nightly
@pytest.mark.parametrize(("optics", "grows"), [("nac", True), ("navcam", False), ("dic", True), ("phone", True)])
def test_a_session_with_each_of_them_is_recorded_and_its_image_goes_as_its_file_says(
    tmp_path: Path, optics: str, grows: bool
):
    require_aravis()
    seen = recorded(optics, tmp_path)
    assert seen.usable.all()
    assert (2 * seen.camera_degC % 1 == 0).all()  # in steps of 0.5 K
    cold, warm = seen.of(Role.REFERENCE), seen.chamber_degC == 38
    first, last = (seen.centres_px[frames].mean(axis=0) for frames in (cold, warm))
    size = [np.linalg.norm(each - each.mean(axis=0), axis=1).mean() for each in (first, last)]
    warmed_K = seen.camera_degC[warm].mean() - seen.camera_degC[cold].mean()
    ppm_per_K = 1e6 * (size[1] / size[0] - 1) / warmed_K
    assert 5 < (ppm_per_K if grows else -ppm_per_K) < 60
