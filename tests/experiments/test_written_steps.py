"""Steps written in a recipe: what they become, where they cannot be, and that today's recipes keep their plans."""

import hashlib

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from thermostand.experiments.recipe_steps import StepEntry
from thermostand.experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PowerCamera,
    Prompt,
    Role,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    Step,
    StopChamber,
)
from thermostand.foundation.documents import load_document, parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import find_packaged


def planned(text: str) -> list[Step]:
    recipe = parse_document(f"name: own\n{text}", Recipe, "own.yaml")
    return [step.step for step in recipe.plan()]


EVERY_STEP = """
steps:
  - power_camera: off
  - prompt: mount the other camera
  - start_chamber: 24
  - cool_down: {max_s: 60}
  - power_camera: on
  - soak_until_settled: {max_s: 900}
  - move_to: {linear: 100, rotary: -5}
  - check_home: linear
  - check_home: [linear, rotary]
  - open_flap
  - capture: {frames: 3, role: validation, interval_s: 1}
  - close_flap:
  - set_temperature: 30
  - soak: 600
  - stop_chamber
"""


def test_every_step_can_be_written():
    settled = SoakUntilSettled(900.0, 600.0, 600.0, 120.0, 0.2, 0.003, 0.1, 24.0)
    assert planned(EVERY_STEP) == [
        PowerCamera(on=False),
        Prompt("mount the other camera"),
        StartChamber(24.0),
        CoolDown(0.5, 1200.0, 60.0),
        PowerCamera(on=True),
        settled,
        MoveTo("linear", 100.0),
        MoveTo("rotary", -5.0),
        CheckHome("linear"),
        CheckHome("linear"),
        CheckHome("rotary"),
        OpenFlap(),
        Capture(3, 1.0, 0.1, Role.VALIDATION, 24.0),
        CloseFlap(),
        SetTemperature(30.0),
        Soak(600.0),
        StopChamber(),
    ]


def test_a_repeat_holds_ramps_and_a_ramp_goes_from_where_the_set_point_is():
    steps = planned(
        """
steps:
  - start_chamber: 20
  - repeat:
      times: 2
      steps:
        - ramp: {to_degC: 25, rate_K_per_min: 0.5, every_K: 2, steps: [capture]}
        - ramp: {to_degC: 20, rate_K_per_min: 5, every_K: 5}
"""
    )
    once: list[Step] = []
    for degC, soak_s in ((22.0, 240.0), (24.0, 240.0), (25.0, 120.0)):
        once += [SetTemperature(degC), Soak(soak_s, band_K=0.0), Capture(1, 0.5, 0.1, Role.OTHER, degC)]
    once += [SetTemperature(20.0), Soak(60.0, band_K=0.0)]
    assert steps == [StartChamber(20.0), *once, *once]


def test_a_ramp_to_where_the_set_point_is_has_no_steps():
    assert planned("steps: [{start_chamber: 20}, {ramp: {to_degC: 20, rate_K_per_min: 1}}]") == [StartChamber(20.0)]


def test_steps_stand_between_the_named_experiments_and_behind_them():
    kinds = [
        type(step)
        for step in planned(
            """
experiments:
  - steps: [{prompt: first}]
  - thermal_cycle: {set_points_degC: [30]}
  - steps: [{prompt: second}]
steps: [{prompt: third}]
"""
        )
    ]
    assert [number for number, kind in enumerate(kinds) if kind is Prompt] == [0, len(kinds) - 2, len(kinds) - 1]


def test_a_capture_may_give_the_set_point_it_is_labelled_with():
    (capture,) = planned("steps: [{capture: {chamber_degC: 22}}]")
    assert capture == Capture(1, 0.5, 0.1, Role.OTHER, 22.0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("description: nothing", "nothing to do; give experiments: with one entry or more, or steps:"),
        ("experiments: [{thermal_cicle: {}}]", "experiments.1: there is no experiment 'thermal_cicle'; did you mean"),
        ("steps: [opn_flap]", "steps.1: there is no step 'opn_flap'; did you mean open_flap? There are start_chamber,"),
        ("steps: [soak]", "steps.1: soak needs a value behind its colon"),
        ("steps: [{soak: -1}]", "steps.1.soak.duration_s: must be greater than or equal to 0 (got -1, line 2)"),
        ("steps: [{soak: 1, open_flap: }]", "an entry is one step, this one has soak and open_flap; begin each with a"),
        ("steps: [{capture: {role: fitt}}]", "steps.1.capture.role: must be 'reference', 'fit', "),
        ("steps: [{capture: {role: settling}}]", "role settling is kept for the looks of soak_until_settled; give"),
        ("steps: [capture]", "steps.1.capture: the chamber has no set-point here; give start_chamber before it"),
        ("steps: [{set_temperature: 30}]", "steps.1.set_temperature: the chamber is stopped here; start_chamber"),
        ("steps: [{start_chamber: 24}, stop_chamber, {set_temperature: 30}]", "steps.3.set_temperature: the chamber"),
        ("steps: [{ramp: {to_degC: 30, rate_K_per_min: 1}}]", "steps.1.ramp: a ramp begins at a set-point; give"),
        (
            "steps: [{start_chamber: 24}, {repeat: {times: 2, steps: [{capture: {role: fit}}]}}]",
            "steps.2.repeat.steps.1.capture: the flap is closed here, and fit frames show the target; give open_flap",
        ),
        ("steps: [{power_camera: off}, {start_chamber: 24}, capture]", "steps.3.capture: the camera is off here; give"),
        ("steps: [{start_chamber: 24}, cool_down]", "steps.2.cool_down: the camera is on here; give power_camera: off"),
        ("steps: [{start_chamber: 24}, open_flap, {soak: 600}]", "steps.3.soak: the flap is open here, and the labor"),
        ("steps: [{soak_until_settled: {max_s: 100}}]", "steps.1.soak_until_settled: max_s 100.0 is the longest"),
        ("experiments: [{steps: [{move_to: linear}]}]", "experiments.1.steps.1.move_to: give keys and values, as in"),
        (
            "steps: [{repeat: {times: 9999, steps: [{repeat: {times: 9999, steps: [open_flap]}}]}}]",
            "steps.1.repeat.steps.1.repeat.steps.1.open_flap: the plan has more than 100000 steps or 20000 captures",
        ),
    ],
)
def test_what_cannot_be_done_is_one_sentence_with_its_place(text: str, sentence: str):
    with pytest.raises(ConfigError) as raised:
        planned(text)
    reported = str(raised.value)
    assert reported.startswith("own.yaml: ")
    assert sentence in reported
    assert "\n" not in reported


# Of the step ids: a session is resumed only when its recipe still gives the same plan.
PLANS = {
    "calibration": "aceab28d8444f110",
    "demo": "091a629569058071",
    "overnight": "b3d43f01d9d98d72",
    "thermal-cycle": "4b4a548cf761f8d6",
    "thermal-cycle-settled": "c3abf061a783e1f7",
    "validation": "9224d7c1ad3c76ac",
    "warm-up": "cba2dba9f006906f",
}


@pytest.mark.parametrize("name", PLANS)
def test_an_installed_recipe_keeps_its_plan(name: str):
    ids = ",".join(step.step_id for step in load_document(find_packaged("recipes", name), Recipe).plan())
    assert hashlib.sha256(ids.encode()).hexdigest()[:16] == PLANS[name]


def test_the_schema_knows_what_may_be_written_in_short():
    schema = Recipe.model_json_schema()
    parts = schema["$defs"]
    assert {"type": "string"} in schema["properties"]["steps"]["items"]["anyOf"]  # `- open_flap`
    assert {"type": "string"} in parts["StepEntry"]["properties"]["check_home"]["anyOf"]
    assert {"const": "settled", "type": "string"} in parts["ThermalCycle"]["properties"]["until"]["anyOf"]
    assert parts["Experiment"]["additionalProperties"]  # experiments of other packages


NAMES = st.sampled_from([*StepEntry.model_fields, "steps", "times", "to_degC", "rate_K_per_min", "frames", "role", "x"])
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.dates() | st.text(max_size=5) | NAMES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES | st.none() | st.integers(), inner, max_size=3),
    max_leaves=12,
)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.dictionaries(st.sampled_from(["experiments", "steps"]), st.lists(VALUES, max_size=4) | VALUES, min_size=1))
def test_whatever_is_written_is_a_plan_or_one_sentence(written: dict[str, object]):
    try:
        recipe = parse_document(yaml.safe_dump({"name": "own", **written}), Recipe, "own.yaml")
    except ConfigError as error:
        assert "\n" not in str(error)  # noqa: PT017 - either is fine
    else:
        assert list(recipe.plan())
