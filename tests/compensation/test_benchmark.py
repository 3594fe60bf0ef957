"""The public benchmark: hidden is what is asked, the same on every run, and a method of one's own is short."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.benchmark.__main__ import load_method, write
from tests.benchmark.benchmark_cases import GROUPS, TASKS, TRAININGS, Case, make_case
from tests.benchmark.methods import METHODS
from tests.benchmark.scoring import format_table, score_method

LONG = ("the form that is chosen", "and a GP on its residual")
"""These fit the others first."""
BINNED = "29 temperature bins of a similarity"
EXAMPLE = Path(__file__).parents[1] / "benchmark" / "example_method.py"


@pytest.fixture(scope="module")
def one() -> Case:
    return make_case(GROUPS[1], 0, TRAININGS[1])


def test_the_frames_that_are_asked_for_have_no_centres_and_the_truth_no_noise(one: Case):
    assert [question.task for question in one.questions] == list(TASKS)
    assert not one.training.of("validation").any()
    for question in one.questions:
        assert len(question.frames) >= 30
        assert np.isnan(question.session.centres_px[question.frames]).all()
        assert not question.session.usable[question.frames].any()
        assert np.isfinite(question.seen_px).all()
        assert 0.01 < np.abs(question.seen_px - question.reference_px).max() < 3
    known = one.training.of("reference")
    assert np.isfinite(one.training.centres_px[known]).all()


def test_it_is_the_same_on_every_run(one: Case):
    again = make_case(GROUPS[1], 0, TRAININGS[1])
    assert np.array_equal(one.training.centres_px, again.training.centres_px, equal_nan=True)
    for first, second in zip(one.questions, again.questions, strict=True):
        assert np.array_equal(first.seen_px, second.seen_px)


def test_a_method_of_one_s_own_is_one_short_file_and_beats_doing_nothing(one: Case):
    assert len(EXAMPLE.read_text().splitlines()) <= 100
    name, method = load_method(EXAMPLE)
    plain, own = (score_method(*each, one) for each in (("nothing", METHODS["nothing"]), (name, method)))
    assert all(score.rms_mpx < before.rms_mpx / 3 for score, before in zip(own, plain, strict=True))
    printed = format_table([*plain, *own], {"nothing": METHODS["nothing"], name: method})
    assert f"1 cameras, {GROUPS[1]}" in printed
    assert "of affine motions |" in printed


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] if name in LONG else []) for name in METHODS]
)
def test_a_method_answers_and_one_with_intervals_says_them(one: Case, name: str):
    found = score_method(name, METHODS[name], one)
    assert np.isfinite([score.rms_mpx for score in found]).all()
    assert np.isfinite(found[0].covered) == (name not in ("nothing", BINNED))
    if name == BINNED:
        assert found[0].rms_mpx < 60  # of some 500 without compensation
    if name in LONG:
        assert found[0].rms_mpx < 15


def test_the_sessions_can_be_written_for_other_programs(one: Case, tmp_path: Path):
    write(one, tmp_path / "cycles")
    names = {path.name for path in (tmp_path / "cycles").iterdir()}
    assert {"1-1-00-training.npz", "1-1-00-task-4.npz", "1-1-00-answers.npz"} <= names
    training = np.load(tmp_path / "cycles" / "1-1-00-training.npz")
    assert np.isnan(training["centres_px"][training["role"] == "validation"]).all()
    answers = np.load(tmp_path / "cycles" / "1-1-00-answers.npz")
    np.testing.assert_array_equal(answers["task_2_seen_px"], one.questions[1].seen_px)
    assert sum(path.stat().st_size for path in (tmp_path / "cycles").iterdir()) * 80 < 2e9
