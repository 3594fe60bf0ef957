"""Each rule and each fault has a hazard; the times of the table are those that are measured."""

import ast
import importlib
import json
import math
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from tests.system.conftest import AS_INSTALLED
from tests.system.hazards import HAZARDS, MEASURED, Trial, document
from tests.system.test_guard_wire import Bench, bench_of
from thermostand import stand
from thermostand.drivers.sim.laboratory_faults import FAULTS
from thermostand.foundation.clock import NS_PER_S
from thermostand.stand.assembly.simulator import Simulator
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.order import Order

POLLED = AS_INSTALLED

TESTS, STAND = Path(__file__).parents[1], Path(stand.__file__).parent
PHASES_S = (0.0, 1.5, 3.5)  # between the fault and the polls, which come each 5 s
_LOOK_S = 0.5
_PLACES = {"Fault": 0, "_ErrorRule": 2}
"""Where a rule's name stands among the arguments: of a fault, and of the table of errors that steps have met."""
_APART_S = 1.0  # virtual time repeats; two looks are for another order of what is due at one instant


def rules_of_the_guard() -> Iterator[str]:
    """The names that faults are given anywhere in `stand`; of a class they are those of its subject."""
    for path in STAND.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text())):
            place = (
                _PLACES.get(call.func.id) if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) else None
            )
            if place is None or not call.args:
                continue
            rule = call.args[place]
            if isinstance(rule, ast.Constant):
                yield str(rule.value)
            elif isinstance(rule, ast.Name):
                module = importlib.import_module(
                    ".".join(("thermostand", *path.relative_to(STAND.parent).with_suffix("").parts))
                )
                yield getattr(module, rule.id)


def test_each_rule_of_the_guard_belongs_to_a_hazard():
    named = {rule for hazard in HAZARDS for rule in hazard.rules}
    assert sorted(set(rules_of_the_guard()) ^ named) == []


def test_each_fault_of_the_simulator_belongs_to_a_hazard():
    patterns = [pattern for hazard in HAZARDS for pattern in hazard.faults]
    assert [name for name in FAULTS if not any(fnmatchcase(name, each) for each in patterns)] == []
    assert [each for each in patterns if not any(fnmatchcase(name, each) for name in FAULTS)] == []


def test_each_test_that_is_named_exists():
    named = [test.rsplit(".", 1) for hazard in HAZARDS for test in hazard.tests]
    missing = [f"{file}.{name}" for file, name in named if f"def {name}(" not in (TESTS / f"{file}.py").read_text()]
    assert missing == []


def test_the_document_is_made_of_the_table():
    assert (TESTS.parent / "docs" / "reference" / "hazards.md").read_text() == document()


async def measured_s(bench: Bench, trial: Trial, phase_s: float) -> list[float]:
    """From the fault to the trip, and from the fault until no heat or cold is permitted any more: the relays' own timer
    may be first."""
    if trial.before:
        await bench.fault(trial.fault, trial.value)
    await bench.start(trial.start_degC, trial.soak_s + phase_s)
    begin_ns = on_ns = bench.clock.now_ns()
    if not trial.before:
        await bench.fault(trial.fault, trial.value)
    if trial.then_degC is not None:
        await bench.assembly.stand.chamber.set_temperature(trial.then_degC)
    found_ns = 0
    while not found_ns or on_ns == bench.clock.now_ns():
        assert bench.clock.now_ns() - begin_ns < trial.within_s * NS_PER_S, trial.name
        await bench.wait(_LOOK_S)
        if any([await bench.plant(each) for each in ("heater_enabled", "compressor_on")]):
            on_ns = bench.clock.now_ns()
        if bench.trips and not found_ns:
            found_ns = bench.clock.now_ns()
    await bench.end()
    return [round((each_ns - begin_ns) / NS_PER_S, 1) for each_ns in (found_ns, on_ns + _LOOK_S * NS_PER_S)]


TRIALS = [trial for hazard in HAZARDS for trial in hazard.trials]


@pytest.mark.nightly
@pytest.mark.parametrize("phase_s", PHASES_S)
@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.name)
async def test_what_is_measured_is_what_the_document_says(
    order: Callable[..., Order], simulator: Callable[[StandConfig, bool], Simulator], trial: Trial, phase_s: float
):
    async with bench_of(order(), simulator) as bench:
        found = await measured_s(bench, trial, phase_s)
    known: dict[str, dict[str, list[float]]] = json.loads(MEASURED.read_text())
    known_s = known.get(trial.name, {}).get(str(phase_s), [math.nan, math.nan])
    measured = json.dumps({trial.name: {phase_s: found}})
    assert found[0] == pytest.approx(known_s[0], abs=_APART_S), measured
    assert found[1] == pytest.approx(known_s[1], abs=_APART_S), measured
