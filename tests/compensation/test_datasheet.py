"""A datasheet's numbers are right within what they claim, agree between sessions, and say how they came to be."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from thermostand.compensation.cli import app
from thermostand.compensation.datasheet.datasheet import (
    BETWEEN_SESSIONS,
    Contribution,
    Datasheet,
    MeasuredQuantity,
    Visits,
    Warming,
    compute_datasheet,
    compute_warm_up_quantities,
    estimate_frame_noise,
    fit_motions,
    pool_sessions,
)
from thermostand.compensation.datasheet.measurement_details import MeasurementDetails, load_details
from thermostand.compensation.drift.model_selection import fit
from thermostand.compensation.drift.paper_model import fit_paper
from thermostand.compensation.observations import Observations
from thermostand.compensation.reporting.pages import render_datasheet_page, serialise_datasheet
from thermostand.compensation.reporting.report_numbers import (
    format_compact,
    format_percent,
    format_significant,
    format_with_expanded_uncertainty,
)
from thermostand.foundation.errors import ConfigError

from .conftest import Recorded
from .drawn_cameras import Camera, Float, centres_px, compute_settled_degC, draw_camera
from .drawn_sessions import NOISE_PX, make_full_session, record_session
from .synthetic import observations

COEFFICIENTS = ("shift_I_per_K", "shift_J_per_K", "scale_per_K", "turn_per_K")


@cache
def make_session(camera_seed: int, effects: tuple[str, ...], seed: int) -> Observations:
    """The same for all tests, who read it only."""
    return record_session(draw_camera(camera_seed, *effects), make_full_session(), seed).observed


def sheet_of(observed: Observations, details: MeasurementDetails | None = None) -> Datasheet:
    """With the paper's form alone, which is quick: it decides on no coefficient."""
    return compute_datasheet(observed, fit_paper(observed), details)


@pytest.fixture(scope="module")
def sheet() -> Datasheet:
    observed = make_session(2003, ("sag",), 1)
    return compute_datasheet(observed, fit(observed))


def at_rest_per_K(camera: Camera) -> Float:
    """The true motions of a camera at rest, around its reference: least squares of the physics, not of the program."""
    cold, warm = (
        centres_px(camera, compute_settled_degC(camera, degC)[None], np.zeros((1, 2)))[0] for degC in (23.0, 25.0)
    )
    x, y = ((cold + warm) / 2 - (1223.5, 1023.5)).T
    one, zero = np.ones(54), np.zeros(54)
    terms = np.concatenate([np.stack([one, zero, x, -y], axis=1), np.stack([zero, one, y, x], axis=1)])
    return np.linalg.lstsq(terms, ((warm - cold) / 2).T.ravel(), rcond=None)[0] * (1, 1, 1e6, 1e6)


def test_the_coefficients_of_drawn_cameras_hold_the_truth_within_their_expanded_uncertainty():
    inside, small = [], []
    for seed in range(5):
        known = sheet_of(make_session(2001 + seed, (), seed)).by_key
        for key, truth in zip(COEFFICIENTS, at_rest_per_K(draw_camera(2001 + seed)), strict=True):
            inside.append(abs(known[key].value - truth) <= known[key].expanded)
        small.append(known["scale_per_K"].expanded / abs(known["scale_per_K"].value))
    assert np.mean(inside) >= 0.85
    assert np.median(small) < 0.05


@pytest.mark.usefixtures("undrawn")
def test_two_sessions_of_a_camera_agree(sheet: Datasheet):
    observed = make_session(2003, ("sag",), 2)
    other = compute_datasheet(observed, fit(observed)).by_key
    for one in sheet.quantities:
        assert abs(one.value - other[one.key].value) <= math.hypot(one.expanded, other[one.key].expanded), one.key
    assert "not measured" not in render_datasheet_page(sheet)
    worse = sheet_of(make_session(2003, ("sag",), 1)).by_key
    assert math.isnan(worse["left_thermal_I"].value)


def test_a_known_motion_is_found():
    def drift(places: Float, above_K: float) -> Float:
        x, y = (places - (1223.5, 1023.5)).T
        scale, turn = 30e-6 * above_K, 5e-6 * above_K
        return places + np.stack(
            [0.01 * above_K + scale * x - turn * y, -0.02 * above_K + scale * y + turn * x], axis=1
        )

    seen = observations(drift)
    found = fit_motions(seen)
    above = seen.chamber_degC - 24.0
    np.testing.assert_allclose(found, above[:, None] * [0.01, -0.02, 30.0, 5.0], atol=1e-6)


def test_a_budget_adds_up_and_its_expanded_uncertainty_is_twice_the_root(sheet: Datasheet):
    for one in sheet.quantities:
        assert one.contributions, one.key
        amounts = {line.source: line.sensitivity * line.u for line in one.contributions}
        total = math.sqrt(
            sum(each**2 for each in amounts.values())
            + sum(2 * r * amounts[first] * amounts[second] for first, second, r in one.correlations)
        )
        assert one.u == pytest.approx(total)
        assert one.expanded == pytest.approx(2 * total)
        assert {line.kind for line in one.contributions} <= {"A", "B"}
        assert one.model


def test_the_air_s_uncertainty_counts_in_what_depends_on_it():
    observed = make_session(2003, ("sag",), 1)
    known, worse = (sheet_of(observed, MeasurementDetails(u_air_K=u_K)).by_key for u_K in (0.1, 0.5))
    for key in (*COEFFICIENTS, "self_heating_K"):
        assert worse[key].u > known[key].u
    assert worse["hysteresis_I"].u == known["hysteresis_I"].u


def test_several_sessions_are_pooled_and_their_difference_is_a_contribution():
    lines = Contribution("noise", "A", 0.3, "px", ""), Contribution("air", "B", 0.1, "K", "", 2.0)
    one = MeasuredQuantity("k", "g", "n", "px", "m").found(1.0, *lines)
    both = pool_sessions([one, replace(one, value=1.2)])
    assert both.value == pytest.approx(1.1)
    a, b, repeated = both.contributions
    assert a.amount == pytest.approx(0.3 / math.sqrt(2))
    assert b.amount == pytest.approx(0.2)
    assert (repeated.source, repeated.amount) == (BETWEEN_SESSIONS, pytest.approx(0.1))
    assert pool_sessions([replace(one, value=math.nan), one]) == one


def after(first: Observations, second: Observations) -> Observations:
    """Both as one, the second two days later."""
    later_ns = 2 * 86_400_000_000_000
    columns = ("frame", "role", "chamber_degC", "camera_degC", "air_degC", "centres_px", "covariance_px2", "flags")
    history = second.histories[0]
    moved = replace(
        history, **{name: getattr(history, name) + later_ns for name in ("ambient_ns", "powered_ns", "camera_ns")}
    )
    return replace(
        first,
        **{name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in columns},
        sessions=first.sessions + second.sessions,
        session=np.concatenate([first.session, second.session + 1]),
        time_ns=np.concatenate([first.time_ns, second.time_ns + later_ns]),
        step_id=first.step_id + second.step_id,
        reasons=first.reasons + second.reasons,
        histories=(*first.histories, moved),
    )


@pytest.mark.usefixtures("undrawn")
def test_of_two_sessions_each_counts_and_their_difference_is_stated():
    camera = draw_camera(2003, "unrepeated")
    one, other = (
        record_session(camera, make_full_session(), seed, session_id=f"cycle-{seed}").observed for seed in (1, 2)
    )
    both = after(one, other)
    sheet = compute_datasheet(both, fit_paper(both))
    assert len(sheet.by_session) == 2
    for pooled_one, first, second in zip(sheet.quantities, *sheet.by_session, strict=False):
        assert pooled_one.value == pytest.approx((first.value + second.value) / 2)
        assert BETWEEN_SESSIONS in {line.source for line in pooled_one.contributions}
    page = render_datasheet_page(sheet)
    assert "From 2 sessions" in page
    assert "One session was recorded" not in page
    assert len(json.loads(serialise_datasheet(sheet))["quantities_by_session"]) == 2


@pytest.mark.usefixtures("undrawn")
def test_without_a_warm_up_the_sheet_says_that_it_was_not_measured():
    made = record_session(draw_camera(2001), make_full_session(with_warm_up=False))
    one = compute_datasheet(made.observed, fit_paper(made.observed))
    assert math.isnan(one.by_key["settling_s"].value)
    page = render_datasheet_page(one)
    assert "not measured" in page
    assert "no warm-up was recorded" in page
    rows = {row["key"]: row for row in json.loads(serialise_datasheet(one))["quantities"]}
    assert rows["settling_s"]["value"] is None
    assert rows["scale_per_K"]["expanded_uncertainty"] > 0


def test_the_page_states_what_was_stated_and_what_was_not(sheet: Datasheet, tmp_path: Path):
    stated = tmp_path / "details.yaml"
    stated.write_text("lens: 25 mm f/1.4\nu_air_K: 0.05\nsensor_positions: {air: beside the camera}\n")
    page = render_datasheet_page(replace(sheet, details=load_details(stated)), [("Exposure", "100 ms")])
    for text in ("25 mm f/1.4", "air: beside the camera", "100 ms", "not stated", "0.05 K (as stated)", "Figure 2."):
        assert text in page
    assert "assumed, since" in render_datasheet_page(sheet)
    assert page == render_datasheet_page(replace(sheet, details=load_details(stated)), [("Exposure", "100 ms")])
    stated.write_text("lense: 25 mm\n")
    with pytest.raises(ConfigError, match="lense"):
        load_details(stated)


@pytest.mark.usefixtures("undrawn")
def test_the_page_says_where_it_holds_what_measured_it_and_how_the_uncertainty_is_made(sheet: Datasheet):
    page = render_datasheet_page(sheet)
    low, high = sheet.air_degC
    for text in ("Valid for", f"{low:.1f} to {high:.1f} °C", "Not covered", "Measured with", "Software", "numpy"):
        assert text in page
    for text in ("type A", "type B", "k = 2"):
        assert text.lower() in page.lower()
    for one in sheet.quantities:
        assert one.name in page


@pytest.mark.parametrize(
    ("value", "expanded", "texts"),
    [
        (-0.018353, 0.000149, ("−0.01835", "0.00015")),
        (1243.4, 16.2, ("1243", "16")),
        (8.66, 0.0996, ("8.66", "0.10")),
        (285.4, 134.0, ("290", "130")),
        (0.0, 0.0, ("0", "–")),
    ],
)
def test_a_value_has_the_decimals_of_its_uncertainty(value: float, expanded: float, texts: tuple[str, str]):
    assert format_with_expanded_uncertainty(value, expanded) == texts


@pytest.mark.parametrize(
    ("value", "u", "text"),
    [(-0.06105, 0.00809, "−0.0611(81)"), (0.5, 0.02, "0.500(20)"), (12.3, 1.44, "12.3(1.4)"), (1.0, 0.0, "1")],
)
def test_a_coefficient_has_its_uncertainty_in_brackets(value: float, u: float, text: str):
    assert format_compact(value, u) == text


@pytest.mark.parametrize(
    ("value", "text"), [(99.97, ">\xa099.9\xa0%"), (100, "100.0 %"), (0.01, "<\xa00.1\xa0%"), (0, "0.0 %")]
)
def test_a_share_is_never_rounded_to_all_or_none(value: float, text: str):
    assert format_percent(value) == text


def test_the_command_writes_what_the_name_says(recorded: Recorded, tmp_path: Path):
    for name, begins in (("camera.html", "<!DOCTYPE html>"), ("camera.json", "{"), ("camera.pdf", "%PDF")):
        done = CliRunner().invoke(app, ["datasheet", str(recorded.path), "-o", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        assert (tmp_path / name).read_bytes().startswith(begins.encode())
    assert (tmp_path / "camera.pdf").stat().st_size > 20_000  # the whole page, though nothing outside is looked up
    document = json.loads((tmp_path / "camera.json").read_text())
    rows = {row["key"]: row for row in document["quantities"]}
    assert rows["shift_J_per_K"]["value"] == pytest.approx(-0.03, abs=0.003)
    assert document["equipment"]["Exposure"] == "100 ms"
    refused = CliRunner().invoke(app, ["datasheet", str(recorded.path), "-o", str(tmp_path / "camera.doc")])
    assert (refused.exit_code, "ends in .html, .pdf, .json" in refused.output) == (2, True)


def test_the_noise_of_the_markers_is_small_against_the_rest(sheet: Datasheet):
    assert NOISE_PX / math.sqrt(54) < sheet.by_key["warm_up_shift_J"].u


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (8.12e-5, 2, "0.000081"),
        (1400.2, 3, "1400"),
        (-2981.0, 3, "−2980"),
        (0.0996, 2, "0.10"),
        (9.96, 2, "10"),
        (0.0, 2, "0.0"),
    ],
)
def test_a_number_of_a_budget_has_its_digits_and_no_exponent(value: float, digits: int, text: str):
    assert format_significant(value, digits) == text


@pytest.mark.parametrize("spacing_s", [5.0, 30.0, 120.0, 240.0])
@pytest.mark.parametrize("noise_px", [0.0, 0.005, 0.02, 0.05])
def test_the_noise_of_a_warm_up_is_that_of_its_frames_and_not_its_curvature(spacing_s: float, noise_px: float):
    rng, at_s = np.random.default_rng(5), np.arange(0.0, 7200.0, spacing_s)
    for constants_s in ((370.0,), (370.0, 1900.0), (90.0, 1200.0)):
        drift = sum(0.3 * -np.expm1(-at_s / constant_s) for constant_s in constants_s)
        found = [estimate_frame_noise(at_s, drift + noise_px * rng.standard_normal(len(at_s))) for _ in range(40)]
        assert math.sqrt(np.mean(np.square(found))) == pytest.approx(noise_px, rel=0.1, abs=5e-4)


def test_the_uncertainty_of_a_warm_up_s_drift_is_no_part_of_the_drift():
    at_s = np.arange(60.0, 4000.0, 120.0)
    moved = np.outer(-np.expm1(-at_s / 370.0), [0.1, 0.3, 20.0, 1.0])
    warming = Warming(at_s, True, np.full(len(at_s), 24.0), 24 + 8 * -np.expm1(-at_s / 370.0), moved - moved[0])
    nothing = np.empty(0)
    visits = Visits(nothing, nothing, nothing, np.empty((0, 4)))
    known = {each.key: each for each in compute_warm_up_quantities(warming, visits, (0.001, 0.001, 1.0, 1.0), 0.1)}
    noise = {key: known[key].contributions[1].amount for key in ("warm_up_shift_I", "warm_up_shift_J")}
    assert max(noise.values()) < 0.0005
