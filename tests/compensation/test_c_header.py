"""The C header says what the Python module says, to 1e-6 px, whatever it is fed; compiled with sanitizers."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.nightly import mark_nightly
from thermostand.compensation.apply.image_correction import warp
from thermostand.compensation.apply.runtime_export import build_runtime_model, export_c, render_header
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.model_selection import fit
from thermostand.compensation.drift_runtime import AMBIENT, CAMERA, HISTORY, STATE, SWITCHED_ON, Drift
from thermostand.foundation.errors import ConfigError

from .compiled_header import COMPILER, STRICT, Float, compile_header, run_header
from .drawn_cameras import draw_camera
from .drawn_sessions import make_full_session, record_session
from .made_up_models import LIFE, POINTS, SIZE, paper, thermal

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler here")

MODELS = {
    "P1": paper(1),
    "P4": paper(4),
    "P5": paper(5),
    "thermal": thermal(),
    "never switched on": thermal(warmed=False),
}
SOME = POINTS[:12]
UNKNOWN = CAMERA | AMBIENT | SWITCHED_ON | HISTORY | STATE


@pytest.fixture(scope="module")
def program_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The compiled program of a model, made when it is first asked for."""

    @cache
    def build(name: str) -> Path:
        return compile_header(export_c(MODELS[name], tmp_path_factory.mktemp("header") / "drift.h"))

    return build


def followed(model: DriftModel, samples: Float, points_px: Float) -> tuple[Drift, Float, Float]:
    """The Python module after them, its corrections (S, N, 2) and flags (S, N)."""
    drift = Drift(dict(build_runtime_model(model)))
    corrected, flags = [], []
    for sample in samples.tolist():
        drift.advance(*sample)
        corrected.append(drift.correct(points_px))
        flags.append(drift.flags(points_px))
    return drift, np.array(corrected), np.array(flags)


@pytest.mark.parametrize("name", [mark_nightly("P1"), mark_nightly("P4"), "P5", "thermal", "never switched on"])
def test_it_corrects_and_flags_as_the_module_at_every_instant(name: str, program_of: Callable[[str], Path]):
    samples = np.array(LIFE, float)
    drift, corrected, flags = followed(MODELS[name], samples, SOME)
    c = run_header(program_of(name), SOME, samples, SIZE)
    np.testing.assert_allclose(c.corrected_px, corrected, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(c.flags, flags)
    shift = corrected - SOME
    np.testing.assert_allclose(c.shift_f32_px, shift, rtol=0, atol=2e-6 * max(1.0, float(np.nanmax(np.abs(shift)))))
    for one, other in zip(c.maps, drift.maps(), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=3e-4)  # of 640 in float32: 6e-5


@pytest.mark.nightly
def test_a_fitted_model_follows_a_whole_session_as_the_module_does(tmp_path: Path):
    made = record_session(draw_camera(1003, "creep", "dead_zone"), make_full_session())
    model, history = fit(made.observed), made.observed.histories[0]
    since_s = (history.ambient_ns - history.ambient_ns[0]) / 1e9
    powered = history.powered[np.searchsorted(history.powered_ns, history.ambient_ns, side="right") - 1]
    camera = np.full(len(since_s), np.nan)
    camera[np.searchsorted(history.ambient_ns, history.camera_ns)] = history.camera_degC
    samples = np.column_stack([np.diff(since_s, prepend=-10.0), history.ambient_degC, powered, camera])
    places = model.facts.reference_centres_px[:8]
    drift, corrected, flags = followed(model, samples, places)
    c = run_header(compile_header(export_c(model, tmp_path / "drift.h")), places, samples, model.facts.image_size)
    np.testing.assert_allclose(c.corrected_px, corrected, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(c.flags, flags)
    assert model.form == "thermal"
    assert np.abs(corrected[-1] - places).max() > 1e-3
    np.testing.assert_allclose(c.maps[0], drift.maps()[0], rtol=0, atol=1e-3)  # float32 at 2448 px: 2.4e-4


def fuzzed(seed: int, count: int) -> Float:
    """Samples that are mostly a life, and now and then anything."""
    rng = np.random.default_rng(seed)
    samples = np.column_stack(
        [
            rng.uniform(0, 600, count),
            24 + np.cumsum(rng.normal(0, 0.5, count)),
            rng.choice([0.0, 0.3, 1.0], count, p=[0.1, 0.1, 0.8]),
            44 + np.cumsum(rng.normal(0, 0.5, count)),
        ]
    )
    odd = np.array([math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 1e308, -1e308, 5e-324, 1e4, -300.0, 1.5, 999.0])
    where = rng.random(samples.shape) < 0.04
    samples[where] = rng.choice(odd, int(where.sum()))
    return samples


@pytest.mark.parametrize("name", ["P5", "thermal"])
@pytest.mark.parametrize("seed", range(3))
def test_whatever_it_is_fed_it_does_as_the_module_and_nothing_undefined(
    name: str, seed: int, program_of: Callable[[str], Path]
):
    samples = fuzzed(seed, 400)
    odd = np.array([math.nan, math.inf, -math.inf, 1e308, -1e9, 1e300, 0.0, 5e-324])
    places = np.concatenate([SOME[:4], np.random.default_rng(seed).choice(odd, (12, 2))])
    with np.errstate(all="ignore"):
        _, corrected, flags = followed(MODELS[name], samples, places)
    c = run_header(program_of(name), places, samples, SIZE)
    np.testing.assert_array_equal(c.flags, flags)
    moderate = np.abs(corrected[:, :4]) < 1e5  # beyond it the temperature was none that an image could survive
    np.testing.assert_allclose(c.corrected_px[:, :4][moderate], corrected[:, :4][moderate], rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(np.isnan(c.corrected_px[:, :4]), np.isnan(corrected[:, :4]))
    strange = ~(np.abs(places) < 1e4).all(axis=1)
    assert (c.flags[:, strange] != 0).all()
    assert (c.flags == 0).any() or name == "thermal"


def test_what_is_unknown_is_flagged_and_has_no_value(program_of: Callable[[str], Path]):
    gap = np.array([[1.0, math.nan, 1.0, 44.0], [1.0, 24.0, 2.0, 44.0], [-1.0, 24.0, 1.0, 44.0], [1, 5000.0, 1, 44.0]])
    c = run_header(program_of("thermal"), SOME, gap, SIZE)
    assert (c.state_flags == UNKNOWN).all()
    assert np.isnan(c.corrected_px).all()
    assert (c.maps == 0).all()  # untouched
    c = run_header(program_of("P5"), SOME, np.array([[1.0, 24.0, 1.0, math.inf], [1.0, math.nan, 1.0, 1e9]]), SIZE)
    assert (c.state_flags == CAMERA).all()


def test_the_maps_correct_an_image_as_the_warp_does():
    drift = Drift(dict(build_runtime_model(thermal())))
    for sample in LIFE:
        drift.advance(*sample)
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    image = (128 + 60 * np.sin(x / 25) * np.cos(y / 31)).astype(np.float32)
    moved: Any = cv2.remap(image, *drift.maps(), cv2.INTER_LANCZOS4)
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(moved[inner] - image[inner]).max() > 0.1
    np.testing.assert_allclose(moved[inner], warp(image, drift.shift)[inner], atol=0.12)  # remap rounds to 1/32 px


def test_two_cameras_fit_into_one_program_in_c_and_in_c_plus_plus(tmp_path: Path):
    export_c(paper(2), tmp_path / "left.h")
    export_c(thermal(), tmp_path / "right.h")
    source = tmp_path / "both.c"
    source.write_text(
        '#include "left.h"\n#include "right.h"\n#include "left.h"\n'
        "int main(void) { left_state a; right_state b; double moved[2]; left_init(&a); right_init(&b);\n"
        "left_advance(&a, 1.0, 24.0, 1.0, 44.0); left_shift(&a, 3.0, 4.0, moved); (void)moved;\n"
        "return (int)(left_flags(&a, 320.0, 200.0) + (right_flags(&b, 0.0, 0.0) == 0u)); }\n"
    )
    assert COMPILER is not None
    program = tmp_path / "both"
    subprocess.run([COMPILER, *STRICT, source, "-o", program, "-lm"], check=True)
    assert subprocess.run([program], check=False).returncode == 0
    subprocess.run([COMPILER, "-x", "c++", "-std=c++11", "-fsyntax-only", "-Wall", "-Wextra", source], check=True)
    fast = subprocess.run([COMPILER, "-ffast-math", "-fsyntax-only", source], capture_output=True, check=False)
    assert b"takes NaN for a number" in fast.stderr


def test_the_documentation_s_example_compiles_and_prints_what_python_says(tmp_path: Path):
    text = (Path(__file__).parents[2] / "docs" / "how-to" / "apply-in-c.md").read_text(encoding="utf-8")
    (example,) = re.findall("```c\n(.*?)```", text, re.DOTALL)
    (tmp_path / "example.c").write_text(example)
    export_c(thermal(), tmp_path / "drift.h")
    assert COMPILER is not None
    program = tmp_path / "example"
    subprocess.run([COMPILER, *STRICT, tmp_path / "example.c", "-o", program, "-lm"], check=True)
    printed = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    point_px = np.array([[1320.5, 1000.25]])
    _, corrected, flags = followed(thermal(), np.tile([10.0, 24.0, 1.0, 44.0], (2000, 1)), point_px)
    assert [float(word) for word in printed[:2]] == pytest.approx(corrected[-1, 0], abs=1e-6)
    assert printed[2] == ("extrapolated" if flags[-1, 0] else "calibrated")


@pytest.mark.parametrize("name", ["drift model.h", "1.h", "drift.txt", "drift"])
def test_a_name_that_is_none_in_c_is_refused(name: str, tmp_path: Path):
    with pytest.raises(ConfigError, match=r"drift\.h"):
        export_c(paper(1), tmp_path / name)


def test_a_serial_number_cannot_end_the_comment():
    model = {**build_runtime_model(paper(1)), "camera_serial": "a */ #error \n b"}
    assert "camera a ?? ?error ? b," in render_header(model)
