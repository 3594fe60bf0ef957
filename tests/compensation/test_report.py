"""The report: one file that needs no other, the same for the same data, with everything that was promised in it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from compensation.drift.paper_fit import fit_paper
from compensation.drift.paper_model import PaperModel
from compensation.drift.validation import Evaluation, evaluate
from compensation.observations import Observations, Role, concatenate
from compensation.report import figures
from compensation.report.report import report_page, write_report
from drivers.interface import SessionError

from .synthetic import facts, observations, quadratic

Analysed = tuple[Observations, PaperModel, Evaluation]


@pytest.fixture(scope="module")
def analysed() -> Analysed:
    night = observations(quadratic, 0.005)
    role = night.role.astype("U16")
    role[:4] = "warm_up"
    reasons = ("",) * 33 + ("found 3 of 54 markers <of> paper-9x6",)
    flags = night.flags.copy()
    flags[5, 7] = 2
    night = replace(night, role=role, reasons=reasons, flags=flags)
    model = fit_paper(night)
    return night, model, evaluate(model, night)


@pytest.fixture(scope="module")
def page(analysed: Analysed) -> str:
    return report_page(*analysed)


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
    assert len(drawings) == 5
    for drawing in drawings:
        ET.fromstring(drawing)
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    used = set(re.findall(r'href="#([^"]+)"', page)) | set(re.findall(r"url\(#([^)]+)\)", page))
    assert used <= set(ids)


def test_the_same_data_give_the_same_bytes(analysed: Analysed, page: str):
    assert report_page(*analysed) == page


def test_it_says_what_was_found_and_what_was_left_out(page: str, analysed: Analysed):
    for text in (
        "Thermal compensation of camera TS-0001",
        "0.191", "0.576", "0.100", "0.090",
        f"{analysed[2].rms_before_px[1]:.3f}",
        f"{analysed[2].rms_after_px[1]:.3f}",
        "night-1", "thermal-cycle",
        "34 (4 reference, 14 fit, 12 validation, 4 warm-up); 1 of them cannot be used",
        "1 set aside (1 saturated)",
        "night-1, frame 33", "found 3 of 54 markers &lt;of&gt; paper-9x6",
        "camera 25.00 to 67.00 °C",
        "numpy",
    ):  # fmt: skip
        assert text in page, text
    assert "simulated" not in page
    rows = re.findall(r"<tr( class=chosen)?><td>(\d)</td><td>(\d+)</td>", page)
    assert [(degree, terms) for _, degree, terms in rows] == [
        ("1", "4"),
        ("2", "10"),
        ("3", "20"),
        ("4", "35"),
        ("5", "56"),
    ]
    assert [degree for chosen, degree, _ in rows if chosen] == [str(analysed[1].degree)]


def test_an_interval_that_claims_too_much_is_told(analysed: Analysed, page: str):
    night, model, evaluation = analysed
    assert "thermal lag, hysteresis" not in page
    assert "thermal lag, hysteresis" in report_page(night, model, replace(evaluation, coverage_95=(0.96, 0.34)))


def test_a_simulated_session_is_called_so(analysed: Analysed):
    night, model, _ = analysed
    for simulated, tells in ((True, True), (False, False)):
        own = replace(night, sessions=(replace(night.sessions[0], simulated=simulated),))
        page = report_page(own, model, evaluate(model, own))
        assert ("Recorded in a simulated laboratory." in page) is tells
        assert ("<td>this report (simulated)</td>" in page) is tells


def test_a_report_that_cannot_be_written_leaves_nothing(analysed: Analysed, tmp_path: Path):
    with pytest.raises(SessionError, match="cannot be written"):
        write_report(tmp_path / "none" / "report.html", *analysed)
    write_report(tmp_path / "report.html", *analysed)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_the_drift_is_measured_from_the_reference_or_else_from_the_first_frame():
    night = observations(quadratic)
    cold = replace(
        observations(quadratic, fit_degC=(10.0, 24.0), held_out_degC=(), session=facts("cold")),
        role=np.array(["warm_up"] * 12),
    )
    moved = figures.drift(concatenate([night, cold]))
    np.testing.assert_allclose(moved[:8], 0, rtol=0, atol=1e-9)
    assert np.abs(moved[-1]).max() < 1e-9  # 24 degC, as in its first frame
    expected = quadratic(night.centres_px[0], -14.0) - night.centres_px[0]
    np.testing.assert_allclose(moved[-3], expected, rtol=0, atol=1e-9)


def test_figures_bear_missing_frames_and_temperatures():
    night = observations(quadratic, 0.005)
    centres, air = night.centres_px.copy(), night.air_degC.copy()
    centres[3] = np.nan
    centres[:, 5] = np.nan
    air[:] = np.nan
    holes = replace(night, centres_px=centres, air_degC=air)
    assert np.isnan(figures.drift(holes)[3]).all()
    for figure in (figures.trajectories(holes, holes.of(*Role)), figures.against_time(holes)):
        assert figures.as_svg(figure, "holes").startswith("<svg")
