"""The report: one file that needs no other, the same for the same data, with everything that was promised in it."""

from __future__ import annotations

import html
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from thermostand.compensation.budget.budget import Budget, BudgetLine
from thermostand.compensation.budget.geometry import ThermometerState
from thermostand.compensation.drift.bumps import MOST_STEPS
from thermostand.compensation.drift.evaluation import Evaluation, evaluate
from thermostand.compensation.drift.paper_model import PaperModel, fit_paper
from thermostand.compensation.drift.terms import compute_features
from thermostand.compensation.history.thermal_history import States, ThermalHistory
from thermostand.compensation.observations import Observations, concatenate
from thermostand.compensation.reporting.drawing import report_figures
from thermostand.compensation.reporting.drawing.figures import (
    PathPanel,
    choose_enlargement,
    draw_trajectories,
    render_svg,
)
from thermostand.compensation.reporting.drawing.report_figures import draw_measured_against_model
from thermostand.compensation.reporting.equipment import list_equipment
from thermostand.compensation.reporting.report import (
    can_be_fitted,
    check_report_writable,
    render_numbers,
    render_report,
    write_report,
)
from thermostand.compensation.reporting.report_numbers import (
    BumpNumbers,
    Extras,
    ReportNumbers,
    collect_numbers,
    describe_formula,
    format_significant,
    serialise_numbers,
)
from thermostand.compensation.reporting.tracks import (
    choose_evenly,
    compute_displacement_px,
    find_cycle,
    find_warm_ups,
    list_visits,
)
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Event

from .made_up_models import thermal
from .synthetic import Float, facts, observations, places_px, quadratic

Analysed = tuple[Observations, PaperModel, Evaluation]
BUDGET = Budget(
    reference=ThermometerState(24.01, 24.02, 24.03, 24.04, 24.05),
    air_degC=(10.5, 51.5),
    contributions=(
        BudgetLine("granite along the axis", 25.17, -0.04861, "the frame's corner", 4.05, 0.00782, True),
        BudgetLine("linear table, resolution", 0.31, 0.00047, "outermost"),
    ),
)
HEADINGS = (
    "Result",
    "Warm-up",
    "Drift over temperature",
    "Before and after compensation",
    "Model",
    "Uncertainty",
    "The stand's budget",
    "Recorded data",
    "Measured with",
    "Frames left out",
)


@pytest.fixture(scope="module")
def analysed() -> Analysed:
    recorded = observations(quadratic, 0.005)
    role = recorded.role.astype("U16")
    role[:4] = "warm_up"
    reasons = ("",) * 33 + ("found 3 of 54 markers <of> paper-9x6",)
    flags = recorded.flags.copy()
    flags[5, 7] = 2
    step_id = ("warm-up",) * 4 + recorded.step_id[4:]
    recorded = replace(recorded, role=role, reasons=reasons, flags=flags, step_id=step_id)
    model = fit_paper(recorded)
    return recorded, model, evaluate(model, recorded)


@pytest.fixture(scope="module")
def written(analysed: Analysed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("written") / "report.html"
    write_report(path, *analysed, Extras(budgets={"cycle-1": BUDGET}))
    return path


@pytest.fixture(scope="module")
def page(written: Path) -> str:
    return written.read_text()


@pytest.fixture(scope="module")
def numbers(analysed: Analysed) -> ReportNumbers:
    return collect_numbers(*analysed)


def warm_up_only(frames: int = 12, roles: tuple[str, ...] = ("warm_up",)) -> Observations:
    """A session in one view; frames take the roles in turn."""
    rising = tuple(np.linspace(24.0, 40.0, frames // 2))
    cold = observations(quadratic, 0.003, fit_degC=rising, held_out_degC=(), session=facts("cold"))
    count = len(cold.role)
    role = np.resize(np.array(roles, "U16"), count)
    time_ns = cold.time_ns[0] + np.arange(count) * 500_000_000
    return replace(cold, role=role, step_id=("warm-up",) * count, time_ns=time_ns)


def headings(page: str) -> list[str]:
    return [html.unescape(text) for text in re.findall("<h2>(.*?)</h2>", page)]


def test_it_needs_no_other_file(page: str):
    assert len(page.encode()) < 3_000_000
    assert "<script" not in page
    assert not re.findall(r'(?:href|src)="(?!#|data:image/png;base64,)', page)
    assert not re.findall(r"url\((?!#)", page)
    assert not re.findall(r"@import|<link|<iframe", page)
    namespaces = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert set(re.findall(r"https?://[^\"'\s<]+", page)) <= namespaces


def test_its_figures_are_sound_svg_with_ids_of_their_own(page: str):
    drawings = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(drawings) == 11
    for drawing in drawings:
        ET.fromstring(drawing)
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    used = set(re.findall(r'href="#([^"]+)"', page)) | set(re.findall(r"url\(#([^)]+)\)", page))
    assert used <= set(ids)


def test_the_same_data_give_the_same_bytes(analysed: Analysed, written: Path, tmp_path: Path):
    write_report(tmp_path / "again.html", *analysed, Extras(budgets={"cycle-1": BUDGET}))
    assert (tmp_path / "again.html").read_bytes() == written.read_bytes()
    assert (tmp_path / "again.json").read_bytes() == written.with_suffix(".json").read_bytes()


def test_it_says_what_was_found_and_what_was_left_out(page: str, analysed: Analysed):
    assert headings(page) == list(HEADINGS)
    for text in (
        "Thermal compensation of camera TS-0001",
        "0.191", "0.576", "0.100", "0.090",
        f"{analysed[2].rms_before_px[1]:.3f}",
        "cycle-1", "thermal-cycle",
        "34 (4 reference, 14 fit, 12 validation, 4 warm-up); 1 of them cannot be used",
        "1 left out (1 saturated)",
        "<td>found 3 of 54 markers &lt;of&gt; paper-9x6</td><td>cycle-1</td><td>1</td><td>33</td>",
        "camera 25.00 to 67.00 °C",
        "<td>granite along the axis</td><td>25.17</td><td>4.05</td><td>-48.61</td><td>7.82</td>",
        "<td>linear table, resolution</td><td>0.31</td><td></td><td>0.47</td><td></td>",
        "numpy",
    ):  # fmt: skip
        assert text in page, text
    assert "simulated" not in page


def test_the_table_of_choice_has_every_degree_and_the_one_in_use_is_bold(page: str, analysed: Analysed):
    rows = re.findall(r"<tr( class=chosen)?><td>paper: P([¹²³⁴⁵])</td><td>(\d+)</td>", page)
    assert [(degree, terms) for _, degree, terms in rows] == [
        ("¹", "8"),
        ("²", "20"),
        ("³", "40"),
        ("⁴", "70"),
        ("⁵", "112"),
    ]
    assert [degree for chosen, degree, _ in rows if chosen] == ["⁰¹²³⁴⁵"[analysed[1].degree]]


def test_page_and_file_have_the_numbers_of_the_evaluation(page: str, written: Path, analysed: Analysed):
    _, model, evaluation = analysed
    found = json.loads(written.with_suffix(".json").read_text())
    score = found["score"]
    assert tuple(score["before_px"]) == evaluation.rms_before_px
    assert tuple(score["after_px"]) == evaluation.rms_after_px
    assert tuple(score["coverage_95"]) == evaluation.coverage_95
    assert score["centres"] == len(evaluation.after_px)
    assert [row["chamber_degC"] for row in score["temperatures"]] == [14.0, 20.0, 27.0, 34.0, 41.0, 48.0]
    assert found["model"]["discrepancy_px"] == model.discrepancy_px.tolist()
    for row in score["temperatures"]:
        cells = (f"{row['before_px'][0]:.3f}", f"{1e3 * row['after_px'][0]:.1f}", f"{row['before_px'][1]:.3f}")
        assert "".join(f"<td>{cell}</td>" for cell in cells) in page
    i, j = found["warm_ups"][0]["drift_px"]
    assert f"<td>{i:.3f}</td><td>{j:.3f}</td>" in page
    gap = found["hysteresis_before"][0]["largest_px"]
    assert gap == [None, None] or f"{1e3 * gap[1]:z.1f}" in page
    assert found["budgets"]["cycle-1"]["contributions"][1]["u_um"] is None
    assert found["unusable"] == [
        {"session_id": "cycle-1", "reason": "found 3 of 54 markers <of> paper-9x6", "frames": [33]}
    ]


def test_the_uncertainty_is_what_noise_and_model_make(numbers: ReportNumbers):
    score = numbers.score
    assert score is not None
    np.testing.assert_allclose(score.marker_sigma_px, 0.005 * np.sqrt(1 + 1 / 4), rtol=1e-6)
    assert (np.array(score.claimed_sigma_px) >= score.marker_sigma_px).all()
    assert f"<td>{1e3 * score.claimed_sigma_px[0]:.2f}</td>" in render_numbers(numbers)


def test_an_interval_that_claims_too_much_is_reported(numbers: ReportNumbers):
    assert numbers.score is not None
    too_few = replace(numbers, score=replace(numbers.score, coverage_95=(0.96, 0.34)))
    assert "thermal lag, hysteresis" not in render_numbers(numbers)
    assert "thermal lag, hysteresis" in render_numbers(too_few)


def test_a_model_of_one_session_says_what_one_session_does_not_show(numbers: ReportNumbers):
    assert numbers.model is not None
    one = replace(numbers.model, between_sessions_px=(0.004, 0.009))
    two = replace(one, session_ids=("cycle-1", "cycle-2"), sessions_compared=2)
    for model, message, row in (
        (one, "was assumed, not measured", "fitted, assumed"),
        (two, "", "fitted, of 2 compared"),
        (numbers.model, "is not known", ""),  # of the paper's form
    ):
        page = render_numbers(replace(numbers, model=model))
        assert (f"How well sessions repeat {message}" in page) == bool(message)
        assert ("How well sessions repeat" in page) == bool(message)
        assert ("added by a session" in page) == bool(row)
        assert row in page


@pytest.mark.usefixtures("undrawn")
def test_a_session_with_only_a_warm_up_has_its_drift_alone(tmp_path: Path):
    cold = warm_up_only()
    assert not can_be_fitted(cold)
    for simulated in (True, False):
        own = replace(cold, sessions=(replace(cold.sessions[0], simulated=simulated),))
        write_report(tmp_path / "report.html", own, None, None)
        text = (tmp_path / "report.html").read_text()
        assert headings(text) == ["Result", "Warm-up", "Drift over time", "Recorded data", "Measured with"]
        assert ("in a simulated laboratory" in text) is simulated
        assert ("<td>this report (simulated)</td>" in text) is simulated
    found = json.loads((tmp_path / "report.json").read_text())
    assert found["model"] is None
    assert found["score"] is None
    i, j = found["warm_ups"][0]["drift_px"]
    expected = quadratic(places_px(), 16.0) - places_px()
    np.testing.assert_allclose([i, j], expected.mean(axis=0), atol=0.003)


@pytest.mark.usefixtures("undrawn")
def test_a_session_without_held_out_temperatures_or_warm_up_is_scored_by_leaving_out():
    recorded = observations(quadratic, 0.005, held_out_degC=())
    model = fit_paper(recorded, 2)
    text = render_report(recorded, model, evaluate(model, recorded))
    assert headings(text) == [
        name for name in HEADINGS if name not in ("Warm-up", "The stand's budget", "Frames left out")
    ]
    assert "one temperature left out" in text


@pytest.mark.parametrize("role", ["calibration", "pose"])
def test_a_session_without_any_drift_is_reported_all_the_same(role: str):
    text = render_report(warm_up_only(roles=(role,)), None, None)
    assert headings(text) == ["Result", "Recorded data", "Measured with"]
    assert f"({12 + 8} {role})" in text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("role", ["fit", "other"])
def test_frames_of_ones_own_steps_without_a_reference_are_shown_over_time(role: str):
    own = warm_up_only(roles=(role,))
    text = render_report(own, None, None)
    assert not can_be_fitted(own)
    assert headings(text) == ["Result", "Drift over time", "Recorded data", "Measured with"]
    assert f"({12 + 8} {role})" in text


def test_a_long_warm_up_does_not_make_a_large_page():
    text = render_report(warm_up_only(3600), None, None)
    assert len(text.encode()) < 1_000_000
    assert "only so many" in text


def test_what_a_session_says_of_itself_cannot_change_the_page():
    evil = '"><script>alert(1)</script><b id="x'
    cold = warm_up_only()
    named = replace(facts(evil, evil), recipe=evil, operator=evil, software_version=evil)
    reasons = ("",) * (len(cold.role) - 1) + (evil,)
    target = cold.target.model_copy(update={"name": evil})
    own = replace(cold, sessions=(named,), reasons=reasons, target=target)
    text = render_report(own, None, None)
    assert "<script" not in text
    assert '<b id="x' not in text
    assert text.count("&lt;script&gt;") >= 6
    assert json.loads(serialise_numbers(collect_numbers(own, None, None)))["sessions"][0]["operator"] == evil


@pytest.mark.usefixtures("undrawn")
def test_a_report_that_cannot_be_written_leaves_nothing(tmp_path: Path):
    with pytest.raises(SessionError, match="cannot be written"):
        write_report(tmp_path / "none" / "report.html", warm_up_only(), None, None)
    assert not list(tmp_path.iterdir())


def test_its_numbers_do_not_take_the_place_of_another_file(tmp_path: Path):
    check_report_writable(tmp_path / "report.html", tmp_path / "model.json", None)
    for page_path, model in (("report.json", None), ("model.html", tmp_path / "model.json")):
        with pytest.raises(SessionError, match="would overwrite"):
            check_report_writable(tmp_path / page_path, model)


def test_what_the_model_leaves_of_a_warm_up_is_reported(numbers: ReportNumbers, page: str, analysed: Analysed):
    recorded, model, _ = analysed
    (warm_up,) = numbers.warm_ups  # four of the frames at the reference: nothing is left but noise
    np.testing.assert_allclose(warm_up.left_px, 0.005 * np.sqrt(1 + 1 / 4), rtol=0.15)
    assert "".join(f"<td>{1e3 * value:.1f}</td>" for value in warm_up.left_px) in page
    moved = np.where((recorded.role == "warm_up")[:, None, None], recorded.centres_px + 400, recorded.centres_px)
    (elsewhere,) = collect_numbers(replace(recorded, centres_px=moved), model, None).warm_ups
    assert np.isnan(elsewhere.left_px).all()


def test_the_formula_in_the_report_gives_the_model_s_corrections(analysed: Analysed):
    """The printed coefficients, put into the printed formula, are the model."""
    recorded, model, _ = analysed
    formula = collect_numbers(*analysed).model.formula
    points, degC = places_px()[:5], 41.5
    width, height = recorded.image_size
    low, high = model.facts.camera_range_degC
    i, j = 2 * (points[:, 0] + 0.5) / width - 1, 2 * (points[:, 1] + 0.5) / height - 1
    t = (2 * degC - (low + high)) / (high - low)
    cosine = np.polynomial.chebyshev.Chebyshev.basis
    message = points.copy()
    for name, coefficients in zip(formula.terms, formula.coefficients_px, strict=True):
        a, b, c = map(int, re.fullmatch(r"T(\d)\(i\) T(\d)\(j\) T(\d)\(t\)", name).groups())
        message += coefficients * (cosine(a)(i) * cosine(b)(j) * cosine(c)(t))[:, None]
    np.testing.assert_allclose(message, model.correct(points, degC), atol=1e-9)
    assert formula.sigma_px.shape == formula.coefficients_px.shape
    assert f"/ {width} − 1" in formula.lines[2]


def test_the_formula_of_the_thermal_form_is_its_homography():
    model = thermal()
    formula = describe_formula(model)
    states = States(model.memory, np.full((1, len(model.memory.at) + 2), 30.0))
    amounts = (
        compute_features(states, [term.feature for term in model.terms], model.origin) - np.array(formula.reference)
    ) @ formula.coefficients_px
    a = amounts[0]
    place = np.array([[200.0, 100.0]])
    width, height = model.facts.image_size
    x, y = (place[0, 0] - (width - 1) / 2) / (width / 2), (place[0, 1] - (height - 1) / 2) / (width / 2)
    moved = [
        a[0] + a[2] * x + a[3] * y + (a[6] * x + a[7] * y) * x,
        a[1] + a[4] * x + a[5] * y + (a[6] * x + a[7] * y) * y,
    ]
    np.testing.assert_allclose(model.shift(place, states)[0], moved, atol=1e-9)
    assert formula.terms[:4] == ("1", "T", "T²", "air(10 min)")


def test_figures_are_numbered_and_those_with_a_line_of_equality_have_equal_axes(analysed: Analysed, page: str):
    numbered = re.findall(r"<b>Figure (\d+)\.</b>", page)
    assert numbered == [str(number) for number in range(1, len(numbered) + 1)]
    for axes in draw_measured_against_model(analysed[2]).axes:
        assert axes.get_aspect() == 1


def test_it_has_layouts_for_paper_phones_and_dark_screens_and_says_what_nobody_stated(page: str):
    for rule in ("prefers-color-scheme: dark", "max-width: 40rem", "@media print", "white-space: pre-wrap"):
        assert rule in page
    assert "<td>Lens</td><td>not stated</td>" in page


def test_what_turns_light_on_dark_screens_is_drawn_as_the_rules_expect(page: str):
    for found in (r'<g id="[a-z-]+text_1"', 'style="fill: #ffffff', 'style="stroke: #000000', "#e6e6e6", "#ececec"):
        assert re.search(found, page), found


def test_the_residuals_have_a_scale_of_their_own():
    scale, bar_px = choose_enlargement(0.005, 2448)
    assert (scale, bar_px) == (20_000, 0.01)
    assert 0.5 < scale * 0.005 / (0.06 * 2448) <= 1


def test_suspect_frames_are_named_when_they_are_more_than_noise_alone_gives(numbers: ReportNumbers):
    """1 of 200 frames of noise alone is doubtful."""

    def names_suspects(frames: int, suspect: int) -> bool:
        (session, *_) = numbers.sessions
        own = replace(numbers, sessions=(replace(session, frames=frames, suspect=suspect),), unusable=())
        return "frames are not described by" in render_numbers(own)

    assert [names_suspects(*case) for case in ((60, 1), (60, 2), (1000, 20), (1000, 21))] == [False, True, False, True]


# What a report says of the devices that measured.


@pytest.mark.parametrize(
    ("sensor", "text"),
    [
        ("{channel: 3}", "air"),
        ("{channel: 3, certificate: T-17}", "air (T-17)"),
        (
            "{channel: 3, certificate: T-17, calibrated: 2026-03-11, uncertainty_K: 0.02}",
            "air (T-17 of 2026-03-11, U = 0.02 K)",
        ),
        ("{channel: 3, uncertainty_K: 0.1}", "air (U = 0.1 K)"),
        ("3", "air"),
    ],
)
def test_a_sensor_stands_with_its_certificate_and_uncertainty(sensor: str, text: str) -> None:
    config = f"thermometers: {{air: {sensor}, laboratory: {{channel: 4}}}}"
    session: Any = SimpleNamespace(
        frame_metas=list[Any], camera="camera", events=list[Any], attachment={"config.yaml": config}.get
    )
    assert ("Thermometer channels", f"{text}, laboratory") in list_equipment(session)


def test_devices_are_listed_with_what_they_reported_of_themselves_and_other_cameras_are_not() -> None:
    cameras = [
        identity("camera", "Basler", "a2A", "40001", lens="25 mm"),
        identity("left", "Basler", "a2A", "7", lens=""),
    ]
    events = [
        *cameras,
        identity("relays", "Waveshare", "Relay (8)", ""),
        identity("relays", "Waveshare", "Relay (16)", ""),
    ]
    session: Any = SimpleNamespace(frame_metas=list[Any], camera="camera", events=lambda: events, attachment={}.get)
    assert [found for _, found in list_equipment(session)] == [
        "Basler a2A, serial number 40001, version 1",
        "25 mm",
        "Waveshare Relay (16), version 1",
    ]


def identity(device: str, vendor: str, model: str, serial: str, **more: str) -> Event:
    data = {"device": device, "vendor": vendor, "model": model, "serial_number": serial, "version": "1", **more}
    return Event(0, "info", "device_identity", "", data)


# Which frames are drift, from where it is measured, and since when.


CENTRE_PX = np.array([1223.5, 1023.5])


def warm_up(session: str, roll_deg: float = 0.0, camera: str = "TS-0001") -> Observations:
    """24 to 36 degC in 12 frames, 500 ms apart, of a camera rolled by so much."""
    turn = np.radians(roll_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def seen(reference_px: Float, above_K: float) -> Float:
        rolled = CENTRE_PX + (reference_px - CENTRE_PX) @ rotation.T
        return rolled + np.array([0.01, 0.03]) * above_K

    found = observations(seen, fit_degC=(30.0, 36.0), held_out_degC=(), session=facts(session, camera))
    count = len(found.role)
    return replace(
        found,
        role=np.array(["warm_up"] * count),
        step_id=("warm-up",) * count,
        time_ns=found.time_ns[0] + np.arange(count) * 500_000_000,
    )


def powered(on_ns: list[int]) -> ThermalHistory:
    """Off at 0, on at each instant, off again after 1 s."""
    times = [0] + [time for on in on_ns for time in (on, on + 1_000_000_000)]
    empty = np.zeros(0, np.int64)
    values = np.array([0.0] + [1.0, 0.0] * len(on_ns))
    return ThermalHistory(empty, empty.astype(float), np.array(times, np.int64), values, empty, empty.astype(float))


def test_the_drift_is_measured_from_the_reference_or_else_from_the_first_frame():
    recorded = observations(quadratic)
    cold = observations(quadratic, fit_degC=(10.0, 24.0), held_out_degC=(), session=facts("cold"))
    cold = replace(cold, role=np.array(["warm_up"] * 12))
    moved = compute_displacement_px(concatenate([recorded, cold]))
    np.testing.assert_allclose(moved[:8], 0, rtol=0, atol=1e-9)
    assert np.abs(moved[-1]).max() < 1e-9  # 24 degC, as in its first frame
    expected = quadratic(recorded.centres_px[0], -14.0) - recorded.centres_px[0]
    np.testing.assert_allclose(moved[-3], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("role", [Role.CALIBRATION, Role.POSE, Role.REPEATABILITY, Role.OTHER])
def test_a_target_that_was_moved_on_purpose_is_no_drift(role: Role):
    recorded = observations(quadratic)
    centres, roles = recorded.centres_px.copy(), recorded.role.astype("U16")
    centres[10:13] += 28.0
    roles[10:13] = str(role)
    moved = compute_displacement_px(replace(recorded, centres_px=centres, role=roles))
    assert np.isnan(moved[10:13]).all()
    assert np.nanmax(np.abs(moved)) < 2


def test_a_warm_up_of_a_rolled_camera_is_measured_from_its_own_first_frame():
    both = concatenate([warm_up("upright"), warm_up("rolled", 20.0)])
    normal, rolled = find_warm_ups(both)
    assert normal.track.roll_deg == pytest.approx(0, abs=1e-6)
    assert rolled.track.roll_deg == pytest.approx(20, abs=1e-3)
    for one in (normal, rolled):
        np.testing.assert_allclose(one.track.mean_px[0], 0, atol=1e-9)
        np.testing.assert_allclose(one.track.mean_px[-1], [0.12, 0.36], atol=1e-9)
    assert np.nanmax(np.abs(compute_displacement_px(both))) < 1


def test_a_warm_up_rolled_before_the_reference_of_its_session_does_not_jump():
    recorded, rolled = observations(quadratic), warm_up("x", 20.0)
    roles = np.concatenate([np.array(["warm_up"] * 4), recorded.role[4:]])
    centres = np.concatenate([rolled.centres_px[:4], recorded.centres_px[4:]])
    assert np.nanmax(np.abs(compute_displacement_px(replace(recorded, role=roles, centres_px=centres)))) < 2


def test_a_warm_up_is_timed_from_when_the_camera_was_switched_on():
    cold = warm_up("cold")
    first = int(cold.time_ns[0])
    for on_ns, expected_s in (([first - 4_000_000_000], 4.0), ([first - 90_000_000_000, first - 3_000_000_000], 3.0)):
        (found,) = find_warm_ups(replace(cold, histories=(powered(on_ns),)))
        assert found.power_on_known
        assert found.since_on_s[:2] == pytest.approx([expected_s, expected_s + 0.5])
    for histories in ((), (powered([]),), (powered([first + 1]),)):
        (found,) = find_warm_ups(replace(cold, histories=histories))
        assert not found.power_on_known
        assert found.since_on_s[0] == 0


def test_visits_know_from_which_side_they_were_reached():
    recorded = observations(quadratic, fit_degC=(31.0, 38.0, 31.0, 10.0), held_out_degC=())
    track = find_cycle(recorded, 0)
    assert track is not None
    found = list_visits(recorded, track)
    assert [(one.chamber_degC, one.direction) for one in found] == [(24, 0), (31, 1), (38, 1), (31, -1), (10, -1)]
    expected = (quadratic(places_px(), 14.0) - places_px()).mean(axis=0)
    np.testing.assert_allclose(found[2].mean_px, expected, atol=1e-9)
    assert find_cycle(warm_up("cold"), 0) is None


def test_thinning_keeps_the_ends():
    assert choose_evenly(5, 10).tolist() == [0, 1, 2, 3, 4]
    assert choose_evenly(3600, 4).tolist() == [0, 1200, 2399, 3599]


def test_figures_bear_missing_frames_and_temperatures():
    recorded = observations(quadratic, 0.005)
    centres, air = recorded.centres_px.copy(), recorded.air_degC.copy()
    centres[3] = np.nan
    centres[:, 5] = np.nan
    air[:] = np.nan
    holes = replace(recorded, centres_px=centres, air_degC=air)
    assert np.isnan(compute_displacement_px(holes)[3]).all()
    track = find_cycle(holes, 0)
    assert track is not None
    paths = PathPanel("", track.start_px, track.moved_px, holes.camera_degC[track.frames])
    for figure in (draw_trajectories(holes, [paths]), report_figures.draw_against_time(holes)):
        assert render_svg(figure, "holes").startswith("<svg")


def test_what_a_thermal_imager_saw_stands_beneath_the_drift():
    recorded = observations(quadratic, 0.005)
    times_ns = np.linspace(recorded.time_ns[0] - 10**12, recorded.time_ns[-1] + 10**12, 1000).astype(np.int64)
    spots = {"lens": (times_ns, np.linspace(30.0, 50.0, 1000)), "back": (times_ns, np.full(1000, np.nan))}
    without, seen = recorded, replace(recorded, sessions=(replace(facts(), spots=spots),))
    assert len(report_figures.draw_against_time(without).axes) == 2
    *_, foot = report_figures.draw_against_time(seen).axes
    lens, _ = foot.lines
    hours = (recorded.time_ns[-1] - recorded.time_ns[0]) / 3.6e12
    shown = np.asarray(lens.get_xdata(), np.float64)
    assert 0 <= shown[0] < 0.01 * hours
    assert 0.99 * hours < shown[-1] <= hours
    assert [text.get_text() for text in foot.get_legend().get_texts()][:2] == ["lens", "back"]
    assert foot.get_ylabel() == "thermal imager (°C)"


# What made the report, and what the paper's own polynomial does with the same frames.


def test_the_report_names_the_program_its_command_and_the_session_s_hash(numbers: ReportNumbers):
    made, (session, *_) = numbers.made_by, numbers.sessions
    own = replace(
        numbers,
        made_by=replace(made, version="9.8.7", commit="0123abcd4567", command="compensate report a/b -o 'c d.html'"),
        sessions=(replace(session, sha256=64 * "e"),),
    )
    page = render_numbers(own)
    for text in ("thermostand 9.8.7, commit 0123abcd4567", "compensate report a/b -o &#39;c d.html&#39;", 64 * "e"):
        assert text in page
    assert "no manifest" in render_numbers(numbers)
    assert "commit" not in render_numbers(replace(own, made_by=replace(own.made_by, commit="")))


def test_the_paper_s_degree_stands_with_its_own_gain_formula_and_mm(numbers: ReportNumbers, analysed: Analysed):
    observations, _, evaluation = analysed
    paper = numbers.paper_form
    assert paper is not None
    assert (paper.degree, len(paper.formula.terms)) == (4, 35)
    assert paper.score.before_px == evaluation.rms_before_px
    own = evaluate(fit_paper(observations, 4), observations)
    np.testing.assert_allclose(paper.score.after_px, own.rms_after_px, rtol=1e-9)
    spread = [np.ptp(each[:, 0]) for each in (observations.target.coordinates_mm(), observations.centres_px[0])]
    assert paper.score.mm_per_px == pytest.approx(spread[0] / spread[1], rel=0.01)
    (first, *_), page = paper.score.temperatures, render_numbers(numbers)
    assert f"<td>{format_significant(math.hypot(*first.after_px) * paper.score.mm_per_px, 2)}</td>" in page
    assert "P4 after, mm" in page
    assert paper.score.question == "same session, interpolated"


def test_a_session_with_as_many_steps_as_are_looked_for_may_have_more(numbers: ReportNumbers):
    one = BumpNumbers(
        "night-1", "2026-01-01T00:00:00", "2026-01-01T00:01:00", 0, 1, (0.1,) * 4, (0.01,) * 4, None, "moved"
    )
    stated = "as many steps were found as are looked for"
    assert stated in render_numbers(replace(numbers, bumps=(one,) * MOST_STEPS))
    assert stated not in render_numbers(replace(numbers, bumps=(one,) * (MOST_STEPS - 1)))
    assert stated not in render_numbers(replace(numbers, bumps=(replace(one, marker=3),) * MOST_STEPS))
