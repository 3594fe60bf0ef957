"""What does not repeat, named: slips move the image along one line, fixings that settle again in any direction."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.drift.bumps import Cause, UnrepeatedMotion, find_bumps, find_unrepeated
from thermostand.compensation.drift.evaluation import evaluate
from thermostand.compensation.drift.model_selection import fit
from thermostand.compensation.reporting.report import write_report

from .drawn_cameras import draw_camera
from .drawn_sessions import make_followed_cycle, make_full_session, record_session, reference, warm_up

DIRECTION = np.array([0.6, -0.8])


def of(seed: int, *effects: str, moving: bool = False) -> UnrepeatedMotion:
    """Its slips are those of a joint that gives way after 4 K or so, by 20 mpx; its fixings settle within 8 mpx."""
    camera = replace(draw_camera(seed, *effects), slip_K=4.0, slip_px_per_K=0.005 * DIRECTION, fixing_px=0.008)
    parts = [*warm_up(), *reference(), *make_followed_cycle()] if moving else make_full_session()
    observed = record_session(camera, parts, seed).observed
    (found,) = find_unrepeated(observed, find_bumps(observed))
    return found


@pytest.mark.parametrize("seed", [2300, 2301])
def test_slips_are_distinguished_from_fixings_that_settle_again(seed: int) -> None:
    slips, settling = of(seed, "stick_slip"), of(seed, "unrepeated")
    assert slips.cause is Cause.SLIPS
    assert settling.cause is Cause.SETTLING
    along_deg = np.degrees(np.arctan2(DIRECTION[1], DIRECTION[0]))
    assert slips.direction_deg == pytest.approx(along_deg, abs=10)
    assert "sticks and slips" in slips.text
    assert "settle differently" in settling.text


def test_what_repeats_is_no_slip() -> None:
    found = of(2302, "dead_zone", "far_air")
    assert found.cause is Cause.NOTHING
    assert "at most" in found.text


@pytest.mark.usefixtures("undrawn")
def test_the_report_says_so(tmp_path: Path) -> None:
    camera = replace(draw_camera(2300, "stick_slip"), slip_K=4.0, slip_px_per_K=0.005 * DIRECTION)
    observed = record_session(camera, make_full_session(), 2300).observed
    model = fit(observed, form="thermal")
    write_report(tmp_path / "report.html", observed, model, evaluate(model, observed))
    assert "sticks and slips" in (tmp_path / "report.html").read_text()
    (reported,) = json.loads((tmp_path / "report.json").read_text())["unrepeated"]
    assert (reported["cause"], reported["session_id"]) == ("slips", "cycle-1")
    assert reported["along_px"] > 0.003


def test_slips_of_a_camera_on_its_way() -> None:
    assert of(2302, "creep", "stick_slip", moving=True).cause is Cause.SLIPS
