"""Every two choices of what a stand is made of stand together in one of these combinations: each is a stand that plans
what it can, has the devices it says, and says what it cannot. By night each of the simulated laboratory runs."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest
import yaml
from typer.testing import CliRunner

from tests.system.conftest import require_aravis
from thermostand.compensation.cli import app as compensate
from thermostand.foundation.clock import VirtualClock
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.recording.reading.scan import verify
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.assembly.simulator import describe_laboratory
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.estimating.missing_devices import list_missing_devices
from thermostand.stand.running.order import Order, check_plan
from thermostand.stand.service.bench import list_devices
from thermostand.stand.service.run import run_virtual

Data = dict[str, Any]
SIMULATED: Data = yaml.safe_load(find_packaged("", "simulated").read_text())
SOFTWARE: Data = yaml.safe_load(find_packaged("", "software-regulator").read_text())
TARGET = find_packaged("targets", "paper-9x6").read_text()
STAGE = {"overshoot": 0.5, "acceleration": 1000, "deceleration": 1000, "source": "of nobody, p. 1"}
OTHER_STAGE = {**STAGE, "unit": "mm", "unit_per_step": 0.01, "travel": 100, "speed": 3000, "homing_speed": 1000}
BOARD = find_packaged("registers", "waveshare-relay")


@dataclass(frozen=True, slots=True)
class Choice:
    """One way to fill a place: what it does to the stand's file, and what `list_missing_devices` names ("no flap")."""

    name: str
    change: Callable[[Data], object]
    absent: tuple[str, ...] = ()


def nothing(data: Data) -> None:
    """As it is."""


def regulator(registers: str) -> Choice:
    return Choice(registers, lambda data: data["regulator"].update(registers=registers))


def software(data: Data) -> None:
    data["regulator"] = copy.deepcopy(SOFTWARE["regulator"])
    data["relays"]["channels"]["heat"] = 3


def module(data: Data) -> None:
    data["regulator"] = copy.deepcopy(SOFTWARE["regulator"])
    data["heat_module"] = {"registers": "icpdas-m7024", "unit": 8, "watchdog_s": 12.0}


def chamber(protocol: str) -> Choice:
    def change(data: Data) -> None:
        del data["regulator"]
        known: Data = {"protocol": protocol, "address": "tcp:127.0.0.1:15023", "gap_s": 0.0, "poll_s": 5.0}
        data["climate_chamber"] = known | (
            {} if protocol in ("espec", "simserv") else {"limits_at_panel_degC": [-10, 60]}
        )

    return Choice(protocol, change)


def no_compressor(data: Data) -> None:
    del data["relays"]["channels"]["compressor"]


def other_board(data: Data) -> None:
    """A board whose relays have other addresses; its map lies beside the stand's file."""
    data["relays"]["registers"] = "another-board.yaml"


def no_board(data: Data) -> None:
    if "regulator" not in data:  # only a climate chamber needs none
        del data["relays"]


def thermometers(*names: str) -> Callable[[Data], None]:
    def change(data: Data) -> None:
        data["thermometers"] = {name: data["thermometers"][name] for name in names}

    return change


def one_thermometer(data: Data) -> None:
    """Of the air. Ours controls by another one, or it could not be found wrong."""
    if data.get("regulator", {}).get("kind") == "software":
        thermometers("air", "granite_inside")(data)
        return
    thermometers("air")(data)
    data.setdefault("guard", {})["overrides"] = ["independent_air_sensor"]


def sixteen(data: Data) -> None:
    data["thermometer_module"] |= {"registers": "adam-4015", "further_units": [5, 6]}
    data["thermometers"] |= {f"pt_{number}": {"channel": number} for number in range(5, 16)}
    data["thermometers"]["pt_15"]["role"] = "safety"


def three_cameras(data: Data) -> None:
    for number in (1, 2):
        data["cameras"][f"side_{number}"] = {"address": f"127.0.0.{40 + number}", "poll_s": 5.0, "boot_s": 4.0}


def add_units(data: Data) -> None:
    """An imager, contacts, instruments with a line of their own."""
    data["imager"] = {"folder": "/nowhere/pictures", "spots": {"lens": {"x_px": 80, "y_px": 60}}}
    data["inputs"] = {"registers": "waveshare-inputs", "unit": 9, "contacts": {"door": {"channel": 0}}}
    data["probes"] = {
        "reference": {"protocol": "hart", "address": "tcp:127.0.0.1:15024", "serial_number": "B71234"},
        "hygrometer": {"protocol": "vaisala", "address": "tcp:127.0.0.1:15025"},
    }


NO_LABORATORY = "no thermometer in the laboratory"
NO_GRANITE = ("no thermometer in the granite inside", "no independent air sensor")
PLACES: Mapping[str, tuple[Choice, ...]] = {
    "heat": (
        Choice("omron-e5cc", nothing),
        Choice("software", software),
        Choice("heat module", module),
        *map(chamber, ("espec", "cts", "ascii2", "simserv", "julabo")),
        *map(regulator, ("eurotherm-3200", "watlow-ez-zone", "watlow-f4t")),
    ),
    "relays": (
        Choice("waveshare", nothing),
        Choice("no compressor", no_compressor, ("no compressor",)),
        Choice("another board", other_board),
        Choice("no board", no_board, ("no relay board",)),
    ),
    "flap": (Choice("flap", nothing), Choice("no flap", lambda data: data.pop("flap"), ("no flap",))),
    "axes": (
        Choice("two axes", nothing),
        Choice("no axes", lambda data: data.update(axes={}), ("no stages",)),
        Choice("another stage", lambda data: data["axes"]["linear"].update(profile=dict(OTHER_STAGE), limits=[0, 90])),
    ),
    "thermometers": (
        Choice("5", nothing),
        Choice("1", one_thermometer, (NO_LABORATORY, *NO_GRANITE)),
        Choice("2", thermometers("air", "granite_inside"), (NO_LABORATORY,)),
        Choice("16", sixteen),
    ),
    "cameras": (
        Choice("1 camera", nothing),
        Choice("no camera", lambda data: data.update(cameras={}), ("no cameras",)),
        Choice("3 cameras", three_cameras),
    ),
    "extras": (Choice("alone", nothing), Choice("imager, inputs, probes", add_units)),
}
Combination = tuple[Choice, ...]


def pairwise() -> Iterator[Combination]:
    """Few combinations that have every pair of choices of two places: each begins with one that none had yet, and takes
    what adds the most."""
    places = tuple(PLACES.values())
    left: set[frozenset[tuple[int, str]]] = {
        frozenset({(i, a.name), (j, b.name)})
        for (i, first), (j, second) in itertools.combinations(enumerate(places), 2)
        for a, b in itertools.product(first, second)
    }
    while left:
        first_pair: list[tuple[int, str]] = min(map(sorted, left))
        taken = dict(first_pair)
        for place, choices in enumerate(places):
            if place not in taken:
                seen = tuple(taken.items())
                taken[place] = max(
                    (choice.name for choice in choices),
                    key=lambda name: sum(frozenset({(place, name), each}) in left for each in seen),
                )
        left -= {frozenset(pair) for pair in itertools.combinations(taken.items(), 2)}
        yield tuple(
            next(choice for choice in choices if choice.name == taken[place]) for place, choices in enumerate(places)
        )


COMBINATIONS = tuple(pairwise())
NOT_SIMULATED = {"eurotherm-3200", "watlow-ez-zone", "watlow-f4t"}
RUN_NIGHTLY = tuple(each for each in COMBINATIONS if each[0].name not in NOT_SIMULATED)


def named(combination: Combination) -> str:
    return ", ".join(choice.name for choice in combination)


def written(combination: Combination, folder: Path) -> Data:
    data = copy.deepcopy(SIMULATED)
    for choice in combination:
        choice.change(data)
    if data.get("relays", {}).get("registers") == "another-board.yaml":
        board = yaml.safe_load(BOARD.read_text())
        board |= {"vendor": "Another", "model": "of nobody"}
        (folder / "another-board.yaml").write_text(yaml.safe_dump(board))
        data["relays"]["registers"] = str(folder / "another-board.yaml")
    return data


def configured(data: Data) -> StandConfig:
    return parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")


def steps(data: Data) -> list[object]:
    """A recipe of everything that this stand can do."""
    does: list[object] = [{"start_chamber": 26}, {"soak": 60}]
    does += [{"move_to": {"linear": 3}}] if data["axes"] else []
    capture = {"frames": 1, "interval_s": 10, "exposure_s": 0.1, "role": "reference", "chamber_degC": 26}
    frames: list[object] = [{"capture": capture}] if data["cameras"] else []
    return [*does, "open_flap", *frames, "close_flap"]  # which take no time without a flap


def recipe(does: list[object]) -> Recipe:
    return Recipe.model_validate({"name": "all", "steps": does})


@pytest.mark.parametrize("combination", COMBINATIONS, ids=named)
def test_each_combination_plans_what_it_can_and_says_what_it_cannot(combination: Combination, tmp_path: Path):
    data = written(combination, tmp_path)
    config = configured(data)
    check_plan(recipe(steps(data)).plan(), config)
    start, soak, move, *capture = steps(SIMULATED)
    for key, does, sentence in (
        ("axes", [start, soak, move], "this stand has no axis 'linear', only none"),
        ("cameras", [start, soak, *capture], "needs a camera, and this stand has none"),
    ):
        if not data[key]:
            with pytest.raises(ConfigError, match=sentence):
                check_plan(recipe(does).plan(), config)
    if data["cameras"] and config.relays is None:
        with pytest.raises(ConfigError, match="no relay switches"):
            check_plan(recipe([{"power_camera": False}]).plan(), config)
    missing = [f"no {each.what}" for each in list_missing_devices(config)]
    expected = [absent for choice in combination for absent in choice.absent]
    if "granite_inside" in data["thermometers"]:  # ours is not controlled by the only one
        expected = [each for each in expected if each not in NO_GRANITE]
    if "relays" in data and "no relay board" in expected:  # a regulator keeps its board
        expected.remove("no relay board")
    assert sorted(missing) == sorted(expected)
    devices = assemble(config, Hub(), VirtualClock(0)).devices
    assert (set(devices.axes), set(devices.cameras), set(devices.probes)) == (
        set(data["axes"]),
        set(data["cameras"]),
        set(data.get("probes", {})),
    )
    assert [device is not None for device in (devices.heat_module, devices.inputs, devices.imager)] == [
        name in data for name in ("heat_module", "inputs", "imager")
    ]
    assert {each.name for each in list_devices(config)} >= {
        *(name for name in ("flap", "heat_module", "inputs", "imager") if name in data),
        *(name for key in ("axes", "cameras", "probes") for name in data.get(key, {})),
    }
    described = cast("dict[str, Any]", describe_laboratory(config, virtual=True, seed=1)["devices"])
    assert described["thermometers"]["settings"]["channels"] == {
        name: each.channel for name, each in config.sensors.items()
    }
    assert len(config.sensors) == len(data["thermometers"])


@pytest.mark.nightly
@pytest.mark.parametrize("combination", RUN_NIGHTLY, ids=named)
async def test_each_combination_runs_and_records_what_it_lacks(combination: Combination, tmp_path: Path):
    require_aravis()
    data = written(combination, tmp_path)
    if "imager" in data:
        data["imager"]["folder"] = str(tmp_path / "pictures")
    text, does = yaml.safe_dump(data), recipe(steps(data))
    order = Order(configured(data), does, text, yaml.safe_dump({"name": "all", "steps": steps(data)}), TARGET)
    session = Session.open(await run_virtual(order, tmp_path / "out", 1, lambda _: None))
    assert session.run == "complete"
    assert len(session.frame_metas()) == len(data["cameras"])
    checked = verify(session.path)  # all that each kind of device declares is read
    assert checked.is_sound, checked.findings
    reported = [event.data["what"] for event in session.events() if event.kind == "absent"]
    assert reported == [each.what for each in list_missing_devices(order.config)]
    air_degC = session.readings("thermometers.air")[1]
    assert len(air_degC) > 10
    assert all(len(session.readings(f"thermometers.{name}")[1]) == len(air_degC) for name in order.config.sensors)


CYCLE: Data = {
    "equilibrium_s": 120,
    "set_points_degC": [30, 20, 26],
    "soak_s": 120,
    "reference_frames": 1,
    "frames_per_point": 1,
}


def chosen(**names: str) -> Combination:
    """The first choice of each place but for those named."""
    return tuple(
        next(choice for choice in choices if choice.name == names.get(place, choices[0].name))
        for place, choices in PLACES.items()
    )


FEWEST = chosen(relays="no compressor", flap="no flap", axes="no axes", thermometers="1")


@pytest.mark.parametrize(
    "combination",
    [FEWEST, *(pytest.param(each, marks=pytest.mark.nightly) for each in RUN_NIGHTLY if each[5].name != "no camera")],
    ids=named,
)
async def test_each_combination_is_reported(combination: Combination, tmp_path: Path):
    require_aravis()
    data = written(combination, tmp_path)
    if "imager" in data:
        data["imager"]["folder"] = str(tmp_path / "pictures")
    at = {"table_position": {"linear": 2, "rotary": 1}} if data["axes"] else {}
    points = [30, 26, 28] if combination[1].name == "no compressor" else CYCLE["set_points_degC"]
    written_recipe = yaml.safe_dump(
        {"name": "cycle", "experiments": [{"thermal_cycle": {**CYCLE, **at, "set_points_degC": points}}]}
    )
    cycle = parse_document(written_recipe, Recipe, "recipe.yaml")
    order = Order(configured(data), cycle, yaml.safe_dump(data), written_recipe, TARGET)
    folder = await run_virtual(order, tmp_path / "out", 1, lambda _: None)
    for camera in data["cameras"]:
        page = tmp_path / f"{camera}.html"
        ended = CliRunner().invoke(compensate, ["report", str(folder), "-o", str(page), "--camera", camera])
        assert ended.exit_code == 0, ended.stderr
        assert "Drift over temperature" in page.read_text(encoding="utf-8")


def test_one_thermometer_alone_has_to_be_accepted_by_name_and_is_not_controlled_by():
    data = copy.deepcopy(SIMULATED)
    thermometers("air")(data)
    with pytest.raises(ConfigError, match="independent_air_sensor: 0 is outside"):
        configured(data)
    one_thermometer(data)
    configured(data)
    software(data)
    with pytest.raises(ConfigError, match="no other would show"):
        configured(data)
