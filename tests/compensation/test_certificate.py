"""A certificate holds the truth within U, says what ISO/IEC 17025 asks for, and asks for what it cannot know."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from thermostand.compensation.budget.budget import compute_displacement_px
from thermostand.compensation.budget.geometry import ThermometerState, load_geometry
from thermostand.compensation.certificate.certificate import (
    PROBABILITY,
    CertifiedValue,
    Verdict,
    certify,
    issue_certificate,
    judge,
    simulate_expanded,
)
from thermostand.compensation.certificate.order import Order, load_order
from thermostand.compensation.certificate.stand_correction import (
    SOURCE,
    add_stand_uncertainty,
    correct_for_stand,
)
from thermostand.compensation.cli import app
from thermostand.compensation.datasheet.datasheet import Contribution, MeasuredQuantity, compute_datasheet
from thermostand.compensation.drift.paper_model import fit_paper
from thermostand.compensation.observations import Observations
from thermostand.compensation.reporting.dcc import serialise_dcc
from thermostand.compensation.reporting.pages import render_certificate_page
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.items import Batch, Item
from thermostand.foundation.readings import Reading
from thermostand.recording.reading.session import Session

from .conftest import START_NS, Recorded, record_items
from .drawn_cameras import Float, draw_camera
from .drawn_sessions import make_full_session, record_session
from .synthetic import observations
from .test_datasheet import COEFFICIENTS, at_rest_per_K, make_session

EXAMPLE = Path(__file__).parents[2] / "configs" / "orders" / "example.yaml"
DCC, SI = "{https://ptb.de/dcc}", "{https://ptb.de/si}"
NEEDED = (
    *("number", "received", "issued", "customer", "laboratory", "item", "method", "conditions", "target"),
    *("thermometers", "geometry", "authorised_by"),
)


def stated(**changes: Any) -> dict[str, Any]:
    data = yaml.safe_load(EXAMPLE.read_text("utf-8"))
    data["item"]["serial_number"], data["geometry"] = "TS-0001", "none"
    return {**data, "received": "2025-12-30", "specification": {}, **changes}


def written(folder: Path, data: dict[str, Any]) -> Path:
    path = folder / "order.yaml"
    path.write_text(yaml.safe_dump(data), "utf-8")
    return path


def quantity(*lines: Contribution, value: float = 1.0, **more: Any) -> MeasuredQuantity:
    return replace(MeasuredQuantity("k", "g", "n", "px/K", "m"), value=value, contributions=lines, **more)


def line(u: float, source: str = "a", **more: Any) -> Contribution:
    return Contribution(source, "A", u, "px/K", "b", **more)


def test_what_the_order_lacks_is_asked_for_in_one_sentence(tmp_path: Path):
    with pytest.raises(ConfigError) as found:
        load_order(written(tmp_path, {"remarks": "nothing else"}))
    for name in NEEDED:
        assert name in str(found.value)
    assert str(found.value).count("\n") == 0
    for absent in (None, "", "  "):
        lacking = stated()
        lacking["customer"]["name"] = absent
        with pytest.raises(ConfigError, match=r"customer\.name"):
            load_order(written(tmp_path, lacking))


@pytest.mark.parametrize("name", NEEDED)
def test_each_needed_key_is_needed(name: str, tmp_path: Path):
    data = stated()
    del data[name]
    with pytest.raises(ConfigError, match=name):
        load_order(written(tmp_path, data))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"specification": {"shift_I_per_K": {}}}, "lower, upper"),
        ({"specification": {"shift_I_per_K": {"lower": 1, "upper": 1}}}, "not below"),
        ({"issued": "yesterday"}, "2026-03-31"),
        ({"method": "two\nlines"}, "method"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_wrong_order_gets_a_sentence(changes: dict[str, Any], named: str, tmp_path: Path):
    with pytest.raises(ConfigError, match=named):
        load_order(written(tmp_path, stated(**changes)))


@pytest.mark.parametrize(
    ("value", "lower", "upper", "verdict", "within"),
    [
        (0.0, -1.0, 1.0, "conforms", True),
        (0.9, -1.0, 1.0, "neither is proven", True),
        (1.1, -1.0, 1.0, "neither is proven", False),
        (1.2, -1.0, 1.0, "does not conform", False),
        (-1.2, -1.0, None, "does not conform", False),
        (5.0, -1.0, None, "conforms", True),
        (0.8, None, 1.0, "conforms", True),
    ],
)
def test_conformity_is_stated_only_where_it_is_proven(
    value: float, lower: float | None, upper: float | None, verdict: Verdict, within: bool
):
    one = CertifiedValue(quantity(line(0.1), value=value), 2.0, 0.2, "GUM", 0.2, 0.2)
    found = judge(one, lower, upper)
    assert (found.verdict, found.within) == (verdict, within)
    assert found.guard == pytest.approx(0.1645, rel=1e-3)


def test_monte_carlo_is_the_law_of_propagation_where_that_holds():
    normal = certify(quantity(line(0.3), line(0.4, "b", sensitivity=-2.0)))
    assert normal.expanded == pytest.approx(2 * math.hypot(0.3, 0.8), rel=1e-3)
    assert (normal.method, normal.simulated) == ("GUM", pytest.approx(normal.analytic, rel=0.01))


@pytest.mark.parametrize("r", [-0.9, 0.0, 0.9])
def test_correlated_inputs_count_so_in_both(r: float):
    one = certify(quantity(line(0.3), line(0.4, "b"), correlations=(("a", "b", r),)))
    expected = 2 * math.sqrt(0.09 + 0.16 + 2 * r * 0.12)
    assert one.analytic == pytest.approx(expected, rel=1e-3)
    assert one.simulated == pytest.approx(expected, rel=0.01)


def test_few_degrees_of_freedom_widen_it_as_student_s_t():
    one = certify(quantity(line(1.0, dof=4)))
    assert one.analytic == pytest.approx(2.869, abs=2e-3)  # t of 95.45 %, 4 degrees of freedom (GUM, table G.2)
    assert one.simulated == pytest.approx(one.analytic, rel=0.02)


def test_where_the_law_does_not_hold_monte_carlo_is_certified():
    flat = certify(quantity(line(1.0, is_rectangular=True), line(0.1, "b")))
    assert flat.method == "Monte Carlo"
    assert flat.expanded == flat.simulated == pytest.approx(PROBABILITY * math.sqrt(3), rel=0.02)

    def square(away: Float) -> Float:
        return away[:, 0] ** 2

    bent = quantity(line(1.0, sensitivity=0.0), line(0.01, "b"), value=0.0, equation=square, inputs=1)
    assert certify(bent).method == "Monte Carlo"
    # Between the quantiles of 2.275 and 97.725 % of chi^2 with one degree of freedom.
    assert simulate_expanded(bent) == pytest.approx((5.1888 - 0.00081) / 2, rel=0.02)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"item": stated()["item"] | {"serial_number": "another"}}, "another"),
        ({"received": "2026-02-01"}, "received"),
        ({"issued": "2025-12-31"}, "issued"),
        ({"target": stated()["target"] | {"issued": "2026-06-01"}}, "target"),
        ({"specification": {"no_such_key": {"upper": 1}}}, "no_such_key"),
    ],
)
def test_an_order_that_contradicts_the_sessions_is_refused(changes: dict[str, Any], named: str):
    observed = observations(lambda places, above_K: places + 0.01 * above_K)
    with pytest.raises((ConfigError, SessionError), match=named):
        issue_certificate((), observed, Order.model_validate(stated(**changes)), None)


def test_without_the_air_s_temperature_nothing_is_certified():
    observed = observations(lambda places, above_K: places + 0.01 * above_K, noise_px=1e-3)
    blind = replace(observed, air_degC=np.full(len(observed.frame), np.nan))
    with pytest.raises(SessionError, match="air"):
        issue_certificate((), blind, Order.model_validate(stated(issued="2026-02-01")), None)


@pytest.mark.usefixtures("undrawn")
def test_the_page_states_what_iso_17025_asks_for():
    observed = make_session(2003, ("sag",), 1)
    order = Order.model_validate(stated(specification={"shift_J_per_K": {"upper": 0.1}}, replaces="EX-0000"))
    made = issue_certificate((), observed, order, None)
    page = render_certificate_page(made, [("Exposure", "100 ms")])
    item = order.item
    wanted = (
        *(order.number, order.replaces, order.method, order.conditions, *order.customer.lines, *order.laboratory.lines),
        *(item.manufacturer, item.model, item.serial_number, item.lens, item.lens_serial_number, item.condition),
        *(order.target.certificate, order.thermometers.certificate, order.authorised_by.name),
        *("2025-12-30", "2026-01-01 to 2026-01-02", "2026-01-05", "counter(pages)", "Specimen", "ISO 14253-1:2017"),
        *("relate only to the item", "in full only", "conforms", "motion of the stand itself is in the values"),
    )
    for text in wanted:
        assert text in page, text
    for one in made.values:
        assert one.quantity.name in page
        assert one.expanded > 0
    assert not any(one.quantity.key.startswith("left_") for one in made.values)
    assert page == render_certificate_page(made, [("Exposure", "100 ms")])
    check_structure(ET.fromstring(serialise_dcc(made)))


ORDERED = {
    "digitalCalibrationCertificate": "administrativeData measurementResults",
    "coreData": "countryCodeISO3166_1 usedLangCodeISO639_1 mandatoryLangCodeISO639_1 uniqueIdentifier receiptDate "
    "beginPerformanceDate endPerformanceDate performanceLocation issueDate reportAmendedSubstituted",
    "item": "name description manufacturer model identifications",
    "identification": "issuer value name",
    "respPerson": "person role mainSigner",
    "measurementResult": "name usedMethods usedSoftware measuringEquipments influenceConditions results",
    "usedMethod": "name description norm",
    "measuringEquipment": "name description identifications",
    "influenceCondition": "name data",
    "result": "name data",
    "statement": "name norm declaration conformity data",
    "quantity": "name real",
    "real": "value unit measurementUncertaintyUnivariate",
    "expandedMU": "valueExpandedMU coverageFactor coverageProbability",
}
"""Element -> its children in the schema's order, of those we write. No package that can be installed brings the XSD:
pydcc, dccXMLJSONConv, dcclib and dcc-json-toolkit download it."""


def check_structure(root: ET.Element) -> None:
    """By the schema's rules for what is written: order, texts that are not empty, references that exist."""
    ids = {element.get("id") for element in root.iter()} - {None}
    for element in root.iter():
        name = element.tag.partition("}")[2]
        children = [child.tag.partition("}")[2] for child in element]
        assert children or (element.text or "").strip(), name
        if name in ORDERED:
            places = [ORDERED[name].split().index(child) for child in children]
            assert places == sorted(places), name
        assert element.get("refId") is None or element.get("refId") in ids
        if element.tag == f"{SI}unit":
            assert (element.text or "").startswith("\\")
        if element.tag in (f"{SI}value", f"{SI}valueExpandedMU", f"{SI}coverageFactor"):
            assert math.isfinite(float(element.text or ""))


def test_the_command_writes_page_and_dcc_with_the_same_values(recorded: Recorded, tmp_path: Path):
    path = written(tmp_path, stated())
    done = CliRunner().invoke(app, ["certificate", str(recorded.path), "--order", str(path), "--json"])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "order.pdf").read_bytes().startswith(b"%PDF")
    root = ET.parse(tmp_path / "order.xml").getroot()
    check_structure(root)
    assert root.findtext(f".//{DCC}uniqueIdentifier") == "EX-0001"
    certified = {
        (one.get("id") or "").removeprefix("q_"): [
            float(one.findtext(f".//{SI}{name}") or "nan") for name in ("value", "valueExpandedMU")
        ]
        for one in root.iter(f"{DCC}quantity")
        if one.get("id")
    }
    listed = {each["quantity"]["key"]: each for each in json.loads(done.stdout)["values"]}
    assert set(certified) == set(listed)
    for key, (value, expanded) in certified.items():
        factor = 1e-3 if listed[key]["quantity"]["unit"].startswith("mpx") else 1.0
        assert value == pytest.approx(factor * listed[key]["quantity"]["value"], rel=1e-8)
        assert expanded == pytest.approx(factor * listed[key]["expanded"], rel=1e-8)
    assert certified["shift_J_per_K"][0] == pytest.approx(-0.03, abs=0.003)


def test_the_command_refuses_before_it_writes(recorded: Recorded, tmp_path: Path):
    for data, out in ((stated(number=""), "c.pdf"), (stated(), "c.doc"), (stated(geometry="nowhere.yaml"), "c.pdf")):
        words = ["certificate", str(recorded.path), "--order", str(written(tmp_path, data)), "-o", str(tmp_path / out)]
        done = CliRunner().invoke(app, words)
        assert (done.exit_code, done.stderr.count("\n")) == (2, 1), done.output
        assert [path.name for path in tmp_path.iterdir()] == ["order.yaml"]


# The stand: its thermometers in a recording, its motion in the centres.

NAMES = ("granite_inside", "granite_outside", "artifact", "air", "laboratory")
PAPER = load_geometry("paper")
BEGIN = ThermometerState(24.0, 24.0, 24.0, 24.0, 24.0)


def stand_at(above_K: float) -> ThermometerState:
    return BEGIN.warmer_by(
        granite_inside_degC=0.5 * above_K,
        granite_outside_degC=0.1 * above_K,
        air_degC=above_K,
        artifact_degC=0.02 * above_K,
    )


@pytest.fixture(scope="module")
def observed() -> Observations:
    """A camera of 0.01 px/K along I, seen from a stand that moves as well; 30 s between frames."""

    def drift(places: Float, above_K: float) -> Float:
        moved = compute_displacement_px(stand_at(above_K), BEGIN, PAPER, places)
        return places + moved + [0.01 * above_K, 0.0]

    seen = observations(drift, noise_px=1e-4)
    count = len(seen.frame)
    return replace(seen, time_ns=START_NS + 30_000_000_000 * np.arange(count), session=np.zeros(count, np.int64))


@pytest.fixture(scope="module")
def stand(observed: Observations, tmp_path_factory: pytest.TempPathFactory) -> Session:
    def items(index: int, time_ns: int) -> Iterator[Item]:
        state = stand_at(float(observed.chamber_degC[index]) - 24.0)
        readings = (Reading(f"thermometers.{one}", getattr(state, f"{one}_degC"), "degC", time_ns) for one in NAMES)
        yield Batch("thermometers", time_ns, tuple(readings))

    path = tmp_path_factory.mktemp("sessions") / "cycle"
    asyncio.run(record_items(path, items, len(observed.frame), 30, session_id="cycle", recipe="thermal-cycle"))
    return Session.open(path)


def test_the_stand_s_own_motion_is_taken_out_and_its_uncertainty_counts(observed: Observations, stand: Session):
    plain = compute_datasheet(observed, fit_paper(observed)).by_key
    correction = correct_for_stand([stand], observed, PAPER)
    corrected = compute_datasheet(correction.observations, fit_paper(correction.observations))
    known = add_stand_uncertainty(corrected, correction).by_key
    assert abs(plain["shift_J_per_K"].value) > 1e-3
    assert known["shift_I_per_K"].value == pytest.approx(0.01, abs=2e-5)
    assert known["shift_J_per_K"].value == pytest.approx(0.0, abs=2e-5)
    assert known["scale_per_K"].value == pytest.approx(0.0, abs=0.02)
    lines = {one.source: one for one in known["shift_J_per_K"].contributions}
    # The post under the camera rises by 5e-6/K of 100 mm per K inside, half of the air's: known to 10 % and 5 %, and
    # the granite's mean temperature to 1 K at either end of a range of 42 K.
    rise = 0.5 * 5e-6 * 100 / 826 * PAPER.focal_px
    assert lines[SOURCE].amount == pytest.approx(
        rise * math.hypot(0.1, 0.05, math.sqrt(2) * math.hypot(1.0, 0.1) / 42 / 0.5, 2 / 826), rel=0.1
    )


def test_a_stand_that_cannot_be_corrected_gets_a_sentence(observed: Observations, stand: Session, recorded: Recorded):
    other = PAPER.model_copy(update={"image_px": (640, 480)})
    with pytest.raises(ConfigError, match="image_px"):
        correct_for_stand([stand], observed, other)
    with pytest.raises(SessionError):
        correct_for_stand([Session.open(recorded.path)], observed, PAPER)


@pytest.mark.nightly
def test_the_true_coefficients_at_rest_lie_within_what_is_certified():
    """More of them: `python -m tests.bench certificate`."""
    inside: list[bool] = []
    for seed in range(12):
        camera = draw_camera(4001 + seed)
        made = record_session(camera, make_full_session(), seed).observed
        known = compute_datasheet(made, fit_paper(made)).by_key
        for key, truth in zip(COEFFICIENTS, at_rest_per_K(camera), strict=True):
            inside.append(abs(known[key].value - truth) <= certify(known[key]).expanded)
    assert np.mean(inside) >= 0.9
