"""Steps that somebody wants to replace others by: what is wrong is reported of each, and nothing is changed."""

import asyncio
from pathlib import Path
from typing import Any, cast

import pytest
from pydantic import JsonValue

from tests.stand.fake_service import FakeService, serve_fake
from thermostand.experiments.steps import Capture, OpenFlap, Soak, StartChamber, StopChamber, number_steps
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.running.memory.entries import StepChanged
from thermostand.stand.running.memory.fold import fold
from thermostand.stand.running.run_control import check_edit, resolve_steps
from thermostand.stand.serving.api_models import WrittenStep
from thermostand.stand.serving.client import find_session_server

PLAN = tuple(number_steps([StartChamber(24.0), Soak(60.0), OpenFlap(), StopChamber()]))
BEGUN = fold(PLAN, [StepChanged(0, PLAN[0].step_id, "started"), StepChanged(0, PLAN[0].step_id, "done")])
CONFIG = load_config(find_packaged("", "simulated"))


def written(kind: str, **parameters: JsonValue) -> WrittenStep:
    return WrittenStep(kind=kind, parameters=parameters)


SOAK = written("soak", duration_s=600.0)
FIT = written("capture", frames=2, interval_s=60.0, exposure_s=0.1, role="fit", chamber_degC=24.0)
UNLABELLED = WrittenStep(kind="capture", parameters={k: v for k, v in FIT.parameters.items() if k != "chamber_degC"})
COLDER, OPEN = written("set_temperature", chamber_degC=18.0), written("open_flap")
UNTIL: dict[str, JsonValue] = {"max_s": 900.0, "min_s": 60.0, "window_s": 240.0, "look_every_s": 60.0}
UNTIL |= {"camera_K_per_min": 0.2, "drift_px_per_min": 0.003, "exposure_s": 0.1}


def labelled(step: WrittenStep, **parameters: JsonValue) -> WrittenStep:
    return WrittenStep(kind=step.kind, parameters={**step.parameters, **parameters})


@pytest.mark.parametrize(
    ("from_index", "steps", "faults"),
    [
        (1, [SOAK, written("soak", duration_s=-1), SOAK, written("Teleport")], {2: "is -1", 4: "no step is called"}),
        (
            1,
            [written("set_temperature", chamber_degC=71), SOAK, UNLABELLED],
            {1: "give -10 to 70", 3: "give open_flap"},
        ),
        (1, [SOAK, written("move_to", axis="linear", position=9e9)], {2: "outside the limits"}),
        (1, [written("move_to", axis="up", position=1), SOAK], {1: "up"}),
        (0, [SOAK], {None: "the steps from number 2 on can be replaced, not those from number 1 on"}),
        (1, [written("soak", duration_s=4e7)], {None: "more than a year is refused"}),
        (1, [OPEN, labelled(FIT, chamber_degC=95)], {2: "95"}),
        (1, [COLDER, OPEN, FIT], {3: "18"}),
        (1, [written("soak_until_settled", **UNTIL, chamber_degC=25)], {1: "25"}),
        (1, [written("soak_until_settled", **UNTIL, role="fit")], {1: "settling"}),
        (1, [OPEN, labelled(FIT, role="settling")], {2: "settling"}),
        (1, [written("stop_chamber"), OPEN, UNLABELLED], {3: "chamber_degC"}),
        (1, [written("stop_chamber"), written("soak_until_settled", **UNTIL, chamber_degC=24)], {2: "start_chamber"}),
    ],
)
def test_what_is_wrong_is_reported_for_each_step(from_index, steps, faults):
    found = check_edit(BEGUN, from_index, steps, CONFIG)
    assert [fault.index for fault in found.faults] == list(faults)
    assert all(text in fault.text for fault, text in zip(found.faults, faults.values(), strict=True))
    assert found.duration_s is None
    assert len(found.texts) == len(steps)


def test_steps_with_which_nothing_is_wrong_have_a_duration_and_their_words():
    found = check_edit(BEGUN, 1, [SOAK, written("open_flap"), FIT], CONFIG)
    assert (found.faults, found.texts[0]) == ((), "soak for 10 min")
    assert found.duration_s == pytest.approx(663.1)


def test_frames_are_at_the_set_point_of_the_steps_before():
    steps = [OPEN, UNLABELLED, COLDER, labelled(FIT, chamber_degC=None), written("stop_chamber"), FIT]
    found = check_edit(BEGUN, 1, steps, CONFIG)
    assert (found.faults, found.set_points_degC) == ((), (24.0, 24.0, 24.0, 18.0, 18.0, None))
    made = [step for step, _ in resolve_steps(PLAN, 1, steps)]
    assert [step.chamber_degC for step in made if isinstance(step, Capture)] == [24.0, 18.0, 24.0]


async def test_the_interface_checks_an_edit_and_gives_the_form_of_each_step(tmp_path: Path):
    async with serve_fake(FakeService(), tmp_path) as desk:
        server = find_session_server(tmp_path)
        body = {"from_index": 0, "steps": [SOAK.model_dump(), {"kind": "soak"}]}
        found = cast("Any", await asyncio.to_thread(server.request, "POST", "/api/v1/run/plan/check", body))
        assert found["faults"][0]["index"] == 1
        schema = cast("Any", await asyncio.to_thread(server.request, "GET", "/api/v1/plan/schema", None))
        assert schema["$defs"]["soak"]["required"] == ["duration_s"]
        for kind in ("capture", "soak_until_settled"):
            assert schema["$defs"][kind]["properties"]["chamber_degC"]["readOnly"]
            assert "chamber_degC" not in schema["$defs"][kind]["required"]
        assert (desk.orders, desk.edited) == ([], ())
