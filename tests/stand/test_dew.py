"""Dew: the formula against a table, the rule of the guard, and plans that would go below it."""

import math
from pathlib import Path

import pytest
import yaml

from thermostand.experiments.steps import SetTemperature, Soak, StartChamber, number_steps
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.config.dew import DewConfig, compute_dew_point_degC
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.estimating.estimate import estimate_return_s, price_plan
from thermostand.stand.estimating.learned_durations import LearnedDurations
from thermostand.stand.guarding.rules import Announcements, make_watches
from thermostand.stand.running.order import load_order
from thermostand.stand.safety.fault import Fault


@pytest.mark.parametrize(
    ("air_degC", "humidity_percent", "expected_degC"),
    [(20.0, 50.0, 9.3), (25.0, 60.0, 16.7), (24.0, 40.0, 9.6), (10.0, 100.0, 10.0), (30.0, 80.0, 26.2)],
)
def test_the_dew_point_is_that_of_the_tables(air_degC: float, humidity_percent: float, expected_degC: float):
    """DIN 4108-3, table of dew points of humid air."""
    assert compute_dew_point_degC(air_degC, humidity_percent) == pytest.approx(expected_degC, abs=0.1)


def test_what_is_not_known_is_not_known():
    assert math.isnan(compute_dew_point_degC(math.nan, 50.0))
    assert math.isnan(DewConfig(humidity_percent=50).lowest_degC(math.nan))
    assert DewConfig(dew_point_degC=12, margin_K=2).lowest_degC(math.nan) == 14


def stand(folder: Path, **sections: object) -> Path:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    for name, section in sections.items():
        data[name] = {**data.get(name, {}), **section} if isinstance(section, dict) else section
    (folder / "stand.yaml").write_text(yaml.safe_dump(data))
    return folder / "stand.yaml"


def camera(**settings: object) -> dict[str, object]:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    return {"camera": {**data["cameras"]["camera"], **settings}}


@pytest.mark.parametrize(
    ("sections", "sentence"),
    [
        ({"dew": {}}, "give dew_point_degC or humidity_percent, one of them"),
        ({"dew": {"dew_point_degC": 10, "humidity_percent": 50}}, "give dew_point_degC or humidity_percent"),
        ({"cameras": camera(ambient_degC=[60, 70])}, "have no temperature in common"),
    ],
)
def test_sections_that_cannot_be_are_refused(tmp_path: Path, sections: dict[str, object], sentence: str):
    with pytest.raises(ConfigError, match=sentence):
        load_config(stand(tmp_path, **sections))


def test_a_plan_that_captures_below_the_dew_point_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"at 10\.0 degC the open flap .* dew point with dew.margin_K is 13 degC"):
        load_order("demo", str(stand(tmp_path, dew={"dew_point_degC": 12})))
    load_order("demo", str(stand(tmp_path, dew={"dew_point_degC": 8})))
    load_order("demo", str(stand(tmp_path, dew={"humidity_percent": 90})))  # not known before it is measured


def test_no_set_point_is_outside_of_what_a_camera_allows(tmp_path: Path):
    config = stand(tmp_path, cameras=camera(ambient_degC=[0, 50]))
    assert load_config(config).set_points_degC[1] == 50
    with pytest.raises(ConfigError, match=r"52\.0 degC is outside cameras.camera.ambient_degC 0\.0\.\.50\.0"):
        load_order("demo", str(config))


def test_no_set_point_changes_faster_than_a_camera_allows(tmp_path: Path):
    back = {"to_ambient": True}
    slow = load_config(stand(tmp_path, cameras=camera(ambient_K_per_min=0.5), ending=back))
    assert slow.set_point_K_per_min == 0.5
    plan = list(number_steps([StartChamber(24.0), SetTemperature(34.0), Soak(60.0, band_K=0.0)]))
    assert [step.duration_s for step in price_plan(plan, slow)] == pytest.approx([0.0, 10.0 / 0.5 * 60.0, 60.0])
    fast = load_config(stand(tmp_path, cameras=camera(), ending=back))
    assert estimate_return_s(plan, slow, LearnedDurations()) == pytest.approx(11.0 / 0.5 * 60.0)
    assert estimate_return_s(plan, fast, LearnedDurations()) < 11.0 / 0.5 * 60.0


class Evening:
    """The guard's rules over a hub, the laboratory at 24 degC and 50 %: its dew point is 12.9 degC."""

    def __init__(self, folder: Path, **sections: object):
        self.hub = Hub()
        dew = {"humidity_percent": 50, "margin_K": 1, "flap_s": 10}
        config = load_config(stand(folder, **{"dew": dew, **sections}))
        self.watches = make_watches(config, Announcements())

    def look(self, at_s: float, flap: float, target_degC: float, camera_degC: float = 40.0) -> list[Fault]:
        values = {
            "flap.position": flap,
            "thermometers.artifact": target_degC,
            "thermometers.laboratory": 24.0,
            "camera.temperature": camera_degC,
        }
        time_ns = to_ns(at_s)
        self.hub.publish(
            Batch("all", time_ns, tuple(Reading(name, value, "1", time_ns) for name, value in values.items()))
        )
        found = [watch.check(self.hub, time_ns) for watch in self.watches]
        return [fault for fault in found if fault is not None and fault.rule == "dew"]


def test_an_open_flap_over_a_cold_target_holds_and_a_closed_one_does_not(tmp_path: Path):
    evening = Evening(tmp_path)
    assert [evening.look(at_s, 0.0, 10.0) for at_s in (0, 20)] == [[], []]
    assert [evening.look(at_s, 1.0, 14.2) for at_s in (21, 40)] == [[], []]
    assert evening.look(50, 1.0, 13.5) == []
    (fault,) = evening.look(61, 1.0, 13.5)
    assert fault.action == "hold"
    assert fault.text.startswith("thermometers.artifact is 13.50 degC")
    assert evening.look(62, 0.0, 13.5) == []
    assert [len(evening.look(at_s, 1.0, 20.0, 5.0)) for at_s in (70, 81)] == [0, 1]


@pytest.mark.parametrize(
    ("humidity_percent", "target_degC", "rules"),
    [(80, 20.0, ["dew"]), (80, 22.0, []), (20, 2.0, []), (None, 13.5, ["dew"]), (None, 14.2, []), (0, 13.5, ["dew"])],
    ids=["wetter than given", "above it", "drier than given", "silent: as given", "silent, above", "no humidity"],
)
def test_what_a_hygrometer_measures_counts_and_what_is_given_while_it_tells_nothing(
    tmp_path: Path, humidity_percent: float | None, target_degC: float, rules: list[str]
):
    """At 24 degC 80 % has its dew point at 20.3, 50 % at 12.9, 20 % at -0.2 degC."""
    evening = Evening(
        tmp_path,
        dew={"humidity_percent": 50, "margin_K": 1, "flap_s": 10, "hygrometer": "hall"},
        probes={"hall": {"protocol": "vaisala", "address": "tcp:127.0.0.1:1"}},
    )
    reported = (
        bad_reading("hall.humidity", "%", 0, "no answer")
        if humidity_percent is None
        else Reading("hall.humidity", humidity_percent, "%", 0)
    )
    evening.hub.publish(Batch("hall", 0, (reported, Reading("hall.temperature", 24.0, "degC", 0))))
    evening.look(0, 1.0, target_degC)
    assert [fault.rule for fault in evening.look(11, 1.0, target_degC)] == rules
