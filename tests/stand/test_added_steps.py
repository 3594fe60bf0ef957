"""A kind of step that another package adds is found everywhere by its one class."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest
import yaml

from tests.installed import install
from tests.stand.small_stand import Life
from thermostand.experiments.steps import (
    STEPS,
    Soak,
    StartChamber,
    Step,
    describe_step,
    make_step,
    make_step_schema,
    number_steps,
)
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.items import Event, StepMark
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.estimating.estimate import price_plan
from thermostand.stand.running.memory.entries import Skipped, decode, encode, make_edit
from thermostand.stand.running.memory.fold import find_refusal
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.safety.gate import INTERLOCK

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "lamp-step"
MODULE = (EXAMPLE / "acme_lamp.py").read_text(encoding="utf-8")
START_NS = 1_767_290_400 * NS_PER_S


@pytest.fixture
def lamp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package, installed; nothing of this program knows it."""
    monkeypatch.syspath_prepend(tmp_path)
    points = {"thermostand.steps": "lamp_on = acme_lamp:LampOn\nno_lamp = acme_none:No"}
    install(tmp_path, "acme-lamp", {"acme_lamp": MODULE}, points)
    yield
    STEPS.pop("lamp_on", None)
    sys.modules.pop("acme_lamp", None)


def recipe(*entries: object) -> Recipe:
    return parse_document(yaml.safe_dump({"name": "own", "steps": list(entries)}), Recipe, "own.yaml")


@pytest.mark.usefixtures("lamp")
def test_a_recipe_names_it_and_its_values_are_checked():
    (_, planned) = recipe({"start_chamber": 24.0}, {"lamp_on": 40.0}).plan()
    assert (planned.step.kind, planned.step.parameters) == ("lamp_on", {"percent": 40.0})
    with pytest.raises(ConfigError, match=r"own.yaml: steps.1.lamp_on: must be .* 100 "):
        recipe({"lamp_on": 140.0})
    with pytest.raises(ConfigError, match=r"own.yaml: steps.1: lamp_on needs"):
        recipe("lamp_on")
    with pytest.raises(ConfigError, match=r"no_lamp: acme-lamp 1.0 cannot be loaded .*; reinstall it"):
        recipe("no_lamp")


@pytest.mark.usefixtures("lamp")
def test_it_has_its_words_its_price_its_form_and_its_limits():
    config = load_config(find_packaged("", "simulated"))
    step = make_step("lamp_on", {"percent": 40.0})
    assert (step.words, describe_step("lamp_on", {"percent": 40.0})) == ("lamp at 40 %", "lamp at 40 %")
    assert [each.duration_s for each in price_plan(number_steps([step]), config)] == [4.0]
    with pytest.raises(ConfigError, match=r"step 1 \(lamp_on\): the lamp"):
        price_plan(number_steps([make_step("lamp_on", {"percent": 95.0})]), config)
    assert cast("dict[str, Any]", make_step_schema()["$defs"])["lamp_on"]["required"] == ["percent"]
    entry = Recipe.model_json_schema()["$defs"]["StepEntry"]["properties"]["lamp_on"]
    assert (entry["anyOf"][0]["minimum"], entry["anyOf"][0]["maximum"]) == (0, 100)


@pytest.mark.usefixtures("lamp")
def test_the_journal_keeps_it_and_a_plan_that_is_changed_has_it():
    steps = (StartChamber(24.0), make_step("lamp_on", {"percent": 40.0}))
    change = make_edit(START_NS, 0, steps)
    assert decode(encode(change)) == change
    state = RunState(tuple(number_steps(steps)))
    assert "sets up" in find_refusal(state, Skipped(START_NS, state.plan[1].step_id))


@pytest.mark.usefixtures("lamp")
def test_it_is_performed_recorded_and_restored_after_a_hold(tmp_path: Path):
    plan = tuple(number_steps([StartChamber(24.0), make_step("lamp_on", {"percent": 40.0}), Soak(60.0, band_K=0.0)]))
    (tmp_path / "life").mkdir()
    life = Life(tmp_path / "life", plan, START_NS, [], 24.0, follows=True)
    try:
        life.passes(10.0)
        marks = [item for item in life.reported if isinstance(item, StepMark) and item.kind == "lamp_on"]
        assert [(mark.state, mark.parameters) for mark in marks] == [
            ("started", {"percent": 40.0}),
            ("done", {"percent": 40.0}),
        ]
        life.interlock()
        life.call(lambda: life.stand.gate.clear(INTERLOCK))
        life.passes(60.0)
    finally:
        life.kill()
    assert sys.modules["acme_lamp"].PERFORMED == [40.0, 40.0]
    restored = [item.text for item in life.reported if isinstance(item, Event) and item.kind == "restored"]
    assert [text.rpartition(", ")[2] for text in restored] == ["lamp at 40 %"]


def test_a_kind_states_whether_it_sets_up():
    with pytest.raises(TypeError, match=r"Half .* is_setup"):

        @dataclass(frozen=True)
        class Half(Step):
            kind = "half"

    assert "half" not in STEPS


def test_a_kind_is_one_word_as_recipes_write_it():
    with pytest.raises(TypeError, match=r"'LampOff' .* one word"):

        @dataclass(frozen=True)
        class LampOff(Step):
            kind = "LampOff"
            is_setup = True

    assert "LampOff" not in STEPS
