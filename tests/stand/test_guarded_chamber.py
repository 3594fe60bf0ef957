"""The guard's table on chambers that are not the simulator's standard one: hot air is found though both probes are
wrong, and good sessions are left alone."""

from collections.abc import Callable, Iterable

import pytest
import yaml

from tests.nightly import mark_nightly
from tests.stand.guarded_chamber import Action, Chamber, iterate_timed
from tests.stand.guarded_failures import FAILURES, HARMLESS, PHASES, FailureRun, Outcome, table
from tests.stand.guarded_recipes import RECIPES, Player
from thermostand.foundation.documents import parse_document
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.guarding.rules import Announcements, make_watches
from thermostand.stand.safety.fault import Fault

CONFIG = load_config(find_packaged("", "simulated"))
LIMIT_DEGC = CONFIG.guard.max_air_degC + 3.0
CHAMBERS = range(10)


def with_thermometers(**thermometers: dict[str, object]) -> StandConfig:
    """The simulated stand with these alone, and no camera; one witness too few is accepted by name."""
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data |= {"thermometers": thermometers, "cameras": {}}
    if "ceiling" not in thermometers:
        data.setdefault("guard", {})["overrides"] = ["independent_air_sensor"]
    return parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")


# Without the granite: with a safety thermometer in its place each failure is found. With the air's alone, and the
# regulator's own probe, any one that fails is, and both that fall out or stand still; not both that are wrong alike.
SAFETY = with_thermometers(air={"channel": 3}, ceiling={"channel": 0, "role": "safety"})
ALONE = with_thermometers(air={"channel": 3})
ALIKE = ("both stuck low", "both drift")
OF_GRANITE = ("granite stuck, PV low",)
BIG_STEPS_DEGC = (24.0, 60.0, -5.0, 60.0, 24.0, 27.0, 24.0)  # as no installed recipe makes


def objections(chamber: Chamber, actions: Iterable[tuple[float, Action]], config: StandConfig = CONFIG) -> list[Fault]:
    """What the table says on the way, warnings too."""
    rules = make_watches(config, Announcements())
    found: list[Fault] = []
    for now_ns in iterate_timed(chamber, actions):
        found.extend(fault for rule in rules if (fault := rule.check(chamber.hub, now_ns)) is not None)
    return [fault for fault in found if fault.rule != "flap_open"]  # nobody announces captures here


def big_steps(set_points_degC: Iterable[float] = BIG_STEPS_DEGC) -> Iterable[tuple[float, Action]]:
    """One hour at each."""

    def at(degC: float) -> Action:
        return lambda chamber: chamber.start(degC)

    return [(3600.0, at(degC)) for degC in set_points_degC]


def check(found: Outcome, failure: str) -> None:
    assert found.hottest_degC < LIMIT_DEGC, (failure, found)
    assert found.fault is not None or failure in HARMLESS, (failure, found)


@pytest.mark.parametrize(
    ("failure", "phase", "chamber_seed", "hot_degC"),
    [
        ("both stuck low", "holding", 9, 60.0),
        ("both out of the chamber", "heating", 0, 52.0),
        ("PV out of the chamber", "cooling", 4, 52.0),
        ("air shorted", "heating", 5, 52.0),
    ],
)
def test_the_air_stays_below_its_limit_when_probes_fail(
    failure: str, phase: str, chamber_seed: int | None, hot_degC: float
):
    check(FailureRun(phase, CONFIG, chamber_seed, hot_degC).outcome(failure), failure)


@pytest.mark.parametrize(
    ("config", "failure", "phase", "chamber_seed", "hot_degC"),
    [
        (SAFETY, "both stuck low", "early", 9, 60.0),
        (SAFETY, "both out of the chamber", "heating", 0, 52.0),
        (ALONE, "PV stuck low", "early", 9, 60.0),
        (ALONE, "PV drifts", "holding", 2, 52.0),
        (ALONE, "both stuck low, air without noise", "early", 9, 52.0),  # at 60 degC it ends at 68.3
        (ALONE, "both out of the chamber", "heating", 0, 52.0),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_so_it_does_without_a_thermometer_in_the_granite(
    config: StandConfig, failure: str, phase: str, chamber_seed: int, hot_degC: float
):
    check(FailureRun(phase, config, chamber_seed, hot_degC).outcome(failure), failure)


@pytest.mark.nightly
@pytest.mark.parametrize("phase", [*PHASES, "early"])
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_so_it_does_in_every_failure_without_a_thermometer_in_the_granite(phase: str):
    for chamber_seed in (None, *CHAMBERS):
        for config, hot_degC, but in ((SAFETY, 60.0, OF_GRANITE), (ALONE, 52.0, (*OF_GRANITE, *ALIKE))):
            failures = [failure for failure in FAILURES if failure not in but]
            for failure, outcome in FailureRun(phase, config, chamber_seed, hot_degC).outcomes(failures).items():
                check(outcome, failure)


@pytest.mark.parametrize("set_points_degC", [BIG_STEPS_DEGC[1:4], mark_nightly(BIG_STEPS_DEGC)])
def test_a_good_day_without_a_thermometer_in_the_granite_is_left_alone(set_points_degC: tuple[float, ...]):
    chamber = Chamber(1, camera_powered=False, channels={"air": 3})
    assert objections(chamber, big_steps(set_points_degC), ALONE) == []


@pytest.mark.nightly
@pytest.mark.parametrize("hot_degC", [52.0, 60.0])
@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # of threads that have nothing to do with a chamber
def test_the_air_stays_below_its_limit_in_every_failure(
    phase: str, hot_degC: float, record_property: Callable[[str, object], None]
):
    found: dict[tuple[str, str], list[Outcome]] = {(f"{failure} at {hot_degC:g}", phase): [] for failure in FAILURES}
    for chamber_seed in (None, *CHAMBERS):
        for failure, outcome in FailureRun(phase, CONFIG, chamber_seed, hot_degC).outcomes(FAILURES).items():
            check(outcome, failure)
            found[f"{failure} at {hot_degC:g}", phase].append(outcome)
    record_property("outcome", table(found))


@pytest.mark.parametrize(
    ("recipe", "chamber_seed"), [("trial", 0), mark_nightly("demo", 0), mark_nightly("warm-up", 2)]
)
def test_a_good_session_is_left_alone(recipe: str, chamber_seed: int):
    assert objections(Chamber(chamber_seed), Player(recipe, interrupted=True).actions()) == []


@pytest.mark.nightly
@pytest.mark.parametrize("recipe", [*RECIPES, "big steps"])
def test_no_good_session_of_ten_chambers_is_disturbed(recipe: str, record_property: Callable[[str, object], None]):
    """Every other chamber's session with holds, pauses and a camera that was off in between."""
    hours = 0.0
    for chamber_seed in CHAMBERS:
        chamber = Chamber(chamber_seed)
        actions = big_steps() if recipe == "big steps" else Player(recipe, chamber_seed % 2 == 0).actions()
        assert objections(chamber, actions) == [], chamber_seed
        hours += chamber.time_s / 3600
    record_property("hours without a false trip or warning", hours)
