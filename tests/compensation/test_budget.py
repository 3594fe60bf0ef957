"""The stand's part in an image: sizes known by hand, the simulated laboratory's own optics, and a recorded session."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from thermostand.compensation import cli
from thermostand.compensation.budget.budget import (
    KELVIN,
    Budget,
    Index,
    average_states,
    ciddor_1996,
    compute_budget,
    compute_displacement_px,
    compute_granite_mm,
    compute_post_mm,
    compute_saturation_Pa,
    edlen_1966,
    measure_home_repeatability,
    vary_inputs,
)
from thermostand.compensation.budget.geometry import Geometry, ThermometerState, load_geometry
from thermostand.drivers.sim.physics import optics
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.items import Batch, Event, Item, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.markers.target import load_target
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import find_packaged

from .conftest import record_items
from .renderer import Scene, photograph, render

PAPER = load_geometry("paper")
TARGET = load_target(find_packaged("targets", "paper-9x6"))
COOL = ThermometerState(24.0, 24.0, 24.0, 24.0, 24.0)
CENTRE_px = np.array([1223.5, 1023.5])
CORNER_px = np.array([2447.0, 2047.0])


def moved_px(xy_px: np.ndarray, geometry: Geometry = PAPER, **degC: float) -> np.ndarray:
    return compute_displacement_px(replace(COOL, **degC), COOL, geometry, xy_px)


def test_granite_inside_warmer_by_30_K_scales_the_image_by_75_ppm_and_the_post_lowers_it():
    warm = replace(COOL, granite_inside_degC=54.0)
    assert 1e3 * compute_granite_mm(warm, COOL, PAPER) == pytest.approx(62, abs=0.05)
    assert 1e3 * compute_post_mm(warm, COOL, PAPER) == pytest.approx(15)
    at_centre, at_corner = moved_px(np.array([CENTRE_px, CORNER_px]), granite_inside_degC=54.0)
    assert at_centre == pytest.approx([0, 0.1316], abs=1e-3)
    assert np.linalg.norm(at_corner - at_centre) == pytest.approx(0.12, abs=0.001)
    assert (at_corner - at_centre < 0).all()


def test_a_rolled_camera_sees_the_post_rise_sideways():
    rolled = PAPER.model_copy(update={"camera_roll_deg": 90.0})
    assert moved_px(CENTRE_px, rolled, granite_inside_degC=54.0) == pytest.approx([0.1316, 0], abs=1e-3)


def test_glass_warmer_by_1_K_grows_by_10_mpx_at_135_mm():
    radius_px = 135 / 826 * PAPER.focal_px
    grown = moved_px(CENTRE_px + np.array([radius_px, 0.0]), artifact_degC=25.0)
    assert grown == pytest.approx([0.0101, 0], abs=1e-4)


@pytest.mark.parametrize(("part", "mpx"), [(0.1, 37), (0.5, 21)])
def test_warm_air_at_the_camera_moves_the_corner_outwards(part: float, mpx: float):
    interface = PAPER.interface_mm.model_copy(update={"value": part * 826})
    dry = PAPER.relative_humidity.model_copy(update={"value": 0.0})
    geometry = PAPER.model_copy(update={"interface_mm": interface, "relative_humidity": dry})
    moved = moved_px(CORNER_px, geometry, air_degC=54.0)
    assert 1e3 * np.linalg.norm(moved) == pytest.approx(mpx, abs=0.6)
    assert (moved > 0).all()


def test_the_correction_takes_out_what_the_simulated_stand_does():
    """The simulator's granite, post and glass; its camera is held still, and it has no refraction."""
    geometry = PAPER.model_copy(update={"target_per_K": PAPER.target_per_K.model_copy(update={"value": 9.0e-6})})
    cool_nodes = optics.Nodes(24.0, 24.0, 24.0, 24.0, 24.0, 24.0)
    warm_nodes = replace(cool_nodes, granite_inside_degC=50.0, granite_outside_degC=27.0, artifact_degC=25.5)
    cool = optics.compute_optics_at("modified", cool_nodes, optics.StandPlacement())
    warm = optics.compute_optics_at("modified", warm_nodes, optics.StandPlacement())
    stand_only = replace(
        cool,
        camera_shift_mm=warm.camera_shift_mm,
        target_centre_mm=warm.target_centre_mm,
        target_scale=warm.target_scale,
    )
    before, after = optics.compute_true_centres_px(cool), optics.compute_true_centres_px(stand_only)
    state = replace(COOL, granite_inside_degC=50.0, granite_outside_degC=27.0, artifact_degC=25.5)
    left = after - compute_displacement_px(state, COOL, geometry, after) - before
    assert np.abs(after - before).max() > 0.15
    assert np.abs(left).max() < 0.010  # the simulated granite expands 5 % more in the warm
    assert (np.abs(left) < 2 * sigma_px(state, COOL, geometry, after) + 1e-4).all()


def sigma_px(state: ThermometerState, reference: ThermometerState, geometry: Geometry, xy_px: np.ndarray) -> np.ndarray:
    """Of the displacement: every uncertain input larger in turn, as a validation does."""
    nominal = compute_displacement_px(state, reference, geometry, xy_px)
    moved = [
        compute_displacement_px(each, reference, other, xy_px) - nominal for each, other in vary_inputs(state, geometry)
    ]
    return np.sqrt(np.square(moved).sum(axis=0))


def test_the_uncertainty_is_that_of_its_inputs():
    warm = replace(COOL, granite_inside_degC=54.0)
    sure = {name: getattr(PAPER, name).model_copy(update={"u": 0.0}) for name in QUANTITIES}
    exact = PAPER.model_copy(update={**sure, "thermometer_K": 0.0, "granite_gradient_K": 0.0})
    assert sigma_px(warm, COOL, exact, CORNER_px) == pytest.approx([0, 0])
    loose = exact.model_copy(update={"granite_per_K": PAPER.granite_per_K})
    tenth = 0.1 * np.abs(compute_displacement_px(warm, COOL, exact, CORNER_px))
    assert sigma_px(warm, COOL, loose, CORNER_px) == pytest.approx(tenth, rel=1e-6)


QUANTITIES = [name for name in Geometry.model_fields if hasattr(getattr(PAPER, name), "u")]


def test_means_leave_out_what_is_unknown():
    mean = average_states(
        [COOL, replace(COOL, air_degC=30.0), replace(COOL, air_degC=math.nan, artifact_degC=math.nan)]
    )
    assert (mean.air_degC, mean.artifact_degC) == (27.0, 24.0)
    assert math.isnan(average_states([replace(COOL, air_degC=math.nan)]).air_degC)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("distance_mm: {value: 50, u: 1}", "interface_mm is between the lens and the target, 0 to 50 mm, not 83"),
        ("relative_humidity: {value: 45, u: 5}", "relative_humidity is a part of 1, not 45"),
        ("pressure_Pa: {value: 1013, u: 5}", "pressure_Pa is in pascal"),
        ("post_mm: 100", "post_mm"),
        ("granite_per_K: {value: 5.0e-6, u: -1}", "granite_per_K.u"),
    ],
)
def test_a_wrong_geometry_gets_a_sentence(line: str, message: str, tmp_path: Path):
    key = line.partition(":")[0]
    geometry = find_packaged("", "simulated").parent / "geometry" / "paper.yaml"
    kept = [old for old in geometry.read_text().splitlines() if not old.startswith(f"{key}:")]
    path = tmp_path / "stand.yaml"
    path.write_text("\n".join([*kept, line]))
    with pytest.raises(ConfigError, match=message):
        load_geometry(str(path))


def test_home_checks_are_read_from_the_recorded_events():
    found = [
        ("home_residual", {"axis": "linear", "residual": 0.003, "unit": "mm"}),
        ("home_residual_large", {"axis": "linear", "residual": -0.004, "unit": "mm"}),
        ("home_residual", {"axis": "rotary", "residual": 0.005, "unit": "deg"}),
        ("homed", {"axis": "linear"}),
    ]
    events = [Event(0, "info", kind, "as its data say", data) for kind, data in found]
    linear, rotary = measure_home_repeatability(events, "mm"), measure_home_repeatability(events, "deg")
    assert (linear.count, rotary.count) == (2, 1)
    assert linear.rms == pytest.approx(math.sqrt((9 + 16) / 2) * 1e-3)
    assert rotary.rms == pytest.approx(0.005)


WARM = ThermometerState(50.0, 27.0, 25.0, 52.0, 24.5)
CAPTURES = (
    ("reference", COOL),
    ("pose", COOL),
    ("repeatability", COOL),
    ("pose", WARM),
    ("pose", WARM),
    ("repeatability", WARM),
)
REPEAT_px = 0.4


def published(number: int, time_ns: int) -> Iterator[Item]:
    """Each capture begins and ends."""
    index, started = number // 2, number % 2 == 0
    role, state = CAPTURES[index]
    names = ("granite_inside", "granite_outside", "artifact", "air", "laboratory")
    readings = tuple(Reading(f"thermometers.{n}", getattr(state, f"{n}_degC"), "degC", time_ns) for n in names)
    yield Batch("thermometers", time_ns, readings)
    mark = StepState.STARTED if started else StepState.DONE
    yield StepMark(time_ns, f"step-{index}", index, "capture", mark, {"role": role, "chamber_degC": state.air_degC})
    if started:
        shift_mm = REPEAT_px / 2 if role == "repeatability" else 0.0  # 2 px per mm
        scene = Scene(size=(640, 480), f_px=2000, diameter_mm=10, shift_mm=(shift_mm, 0.0))
        image = photograph(scene, render(scene), index)
        yield Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, index, 0, 0, f"step-{index}")
        data = {"axis": "linear", "residual": 0.003, "unit": "mm"}
        yield Event(time_ns, "info", "home_residual", "linear: home was at 0.00300 mm (0.24 steps)", data)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sessions") / "cycle"
    attachments = {"target.yaml": find_packaged("targets", "paper-9x6").read_text()}
    how = {"session_id": "cycle", "recipe": "validation", "attachments": attachments}
    asyncio.run(record_items(path, published, 2 * len(CAPTURES), 30, **how))
    return path


@pytest.fixture(scope="module")
def found(session: Path) -> Budget:
    return compute_budget(Session.open(session), TARGET, PAPER)


def test_a_sessions_budget_has_each_part_at_its_largest(found: Budget):
    assert found.reference == COOL
    assert found.air_degC == (24.0, 52.0)
    lines = {line.name: line for line in found.contributions}
    granite = lines["granite along the axis"]
    assert granite.um == pytest.approx(1e3 * 5e-6 * 413 * (26 + 3))
    assert granite.px == pytest.approx(-granite.um / 826e3 * math.hypot(*CENTRE_px))
    assert 0.1 * granite.um < granite.u_um < 0.13 * granite.um
    assert next(line for name, line in lines.items() if name.startswith("granite post")).um == pytest.approx(13)
    assert lines["expansion of the target"].um == pytest.approx(8.5e-6 * math.hypot(120, 75) * 1e3)
    refraction, edlen = lines["refraction, Ciddor 1996"], lines["the same by Edlen 1966, as in the paper"]
    assert 3 < refraction.um < 4.2
    assert 0.1 * refraction.um < refraction.u_um < 0.2 * refraction.um
    assert edlen.um == pytest.approx(refraction.um, rel=0.02)
    assert refraction.um == pytest.approx(114 * refraction.px, rel=1e-3)
    assert lines["rotary table, resolution"].um == pytest.approx(24, abs=1)


def test_what_the_table_repeats_comes_from_the_recording(found: Budget):
    lines = {line.name: line for line in found.contributions}
    assert lines["linear table, 6 home checks"].um == pytest.approx(3)
    assert lines["V0 seen again, 2 times, with the camera"].px == pytest.approx(REPEAT_px / math.sqrt(2), abs=0.005)


def test_the_command_prints_the_table_and_refuses_in_a_sentence(session: Path, tmp_path: Path):
    done = CliRunner().invoke(cli.app, ["budget", str(session)])
    assert done.exit_code == 0, done.output
    assert "refraction, Ciddor 1996" in done.stdout
    assert "captures at 24.0 to 52.0 degC" in done.stdout
    refused = CliRunner().invoke(cli.app, ["budget", str(session), "--geometry", str(tmp_path / "none.yaml")])
    assert refused.exit_code == 2
    assert "none.yaml: no such file" in refused.stderr


# The index of air against published values: NIST's tables and each equation's own.


def birch_downs_1994(temperature_degC: float, pressure_Pa: float, vapour_Pa: float, wavelength_um: float) -> float:
    """n - 1 by K. P. Birch and M. J. Downs, Metrologia 31 (1994) 315: NIST's modified Edlen equation."""
    S, t = wavelength_um**-2, temperature_degC
    standard = (8342.54 + 2406147 / (130 - S) + 15998 / (38.9 - S)) * 1e-8
    density = pressure_Pa / 96095.43 * (1 + 1e-8 * (0.601 - 0.00972 * t) * pressure_Pa) / (1 + 0.003661 * t)
    return standard * density - 1e-10 * (292.75 / (t + KELVIN)) * (3.7345 - 0.0401 * S) * vapour_Pa


EQUATIONS = (edlen_1966, birch_downs_1994, ciddor_1996)
DRY_550_nm = {
    -10: (3.04296, 3.04306, 3.04329),
    10: (2.82745, 2.82756, 2.82759),
    22: (2.71217, 2.71227, 2.71229),
    24: (2.69386, 2.69397, 2.69399),
    40: (2.55580, 2.55592, 2.55600),
    52: (2.46118, 2.46130, 2.46148),
    54: (2.44609, 2.44620, 2.44640),
    70: (2.33165, 2.33178, 2.33215),
}


@pytest.mark.parametrize("degC", DRY_550_nm)
def test_dry_air_at_550_nm(degC: float):
    found = tuple(1e4 * equation(degC, 101325.0, 0.0, 0.55) for equation in EQUATIONS)
    assert found == pytest.approx(DRY_550_nm[int(degC)], abs=6e-6)


@pytest.mark.parametrize(
    ("equation", "dry", "half_saturated"),
    [
        (edlen_1966, 2.717882e-4, 2.712963e-4),
        (birch_downs_1994, 2.717990e-4, 2.713745e-4),
        (ciddor_1996, 2.717998e-4, 2.713727e-4),
    ],
)
def test_dry_and_half_saturated_air_at_633_nm(equation: Index, dry: float, half_saturated: float):
    assert equation(20.0, 101325.0, 0.0, 0.633) == pytest.approx(dry, abs=6e-11)
    assert equation(20.0, 101325.0, 0.5 * compute_saturation_Pa(20.0), 0.633) == pytest.approx(
        half_saturated, abs=6e-11
    )


@pytest.mark.parametrize(("degC", "pascal"), [(26.85, 3536.58941), (226.85, 2638897.76), (0.01, 611.657)])
def test_saturation_pressure_agrees_with_the_iapws_tables(degC: float, pascal: float):
    assert compute_saturation_Pa(degC) == pytest.approx(pascal, rel=1e-5)


def test_heat_pressure_and_humidity_move_the_index_as_known():
    at = ciddor_1996(24.0, 101325.0, 0.0, 0.55)
    assert ciddor_1996(25.0, 101325.0, 0.0, 0.55) - at == pytest.approx(-9.1e-7, rel=0.01)
    assert ciddor_1996(24.0, 101425.0, 0.0, 0.55) - at == pytest.approx(2.7e-7, rel=0.02)
    assert ciddor_1996(24.0, 101325.0, 0.5 * compute_saturation_Pa(24.0), 0.55) - at == pytest.approx(-5.3e-7, rel=0.03)
