"""Every temperature against itself: good sessions are left alone, and what jumps, scatters, sticks or cannot be is
doubted, said and recorded."""

from collections.abc import Callable

import pytest

from tests.nightly import mark_nightly
from tests.stand.checked_chamber import CAMERA, CheckedChamber, Shown, draw_good_run
from tests.stand.guarded_chamber import CHANNELS, Action, Chamber, iterate_timed
from thermostand.foundation.clock import to_ns
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Quality, Reading
from thermostand.stand.config.guard_section import SensorsConfig
from thermostand.stand.guarding.channel_check import ChannelCheck, ChannelModel

AIR, GRANITE, PV, LABORATORY = (
    "thermometers.air",
    "thermometers.granite_inside",
    "regulator.pv",
    "thermometers.laboratory",
)


@pytest.mark.parametrize("seeds", [range(4, 8), mark_nightly(range(100, 200))], ids=["four", "a hundred"])
def test_in_good_sessions_no_temperature_is_suspect(seeds: range):
    for seed in seeds:
        chamber, actions = draw_good_run(seed)
        for _ in iterate_timed(chamber, actions):
            pass
        assert chamber.warnings == [], seed


def offset(kelvins: float) -> Action:
    def act(chamber: Chamber) -> None:
        assert isinstance(chamber, CheckedChamber)
        chamber.camera_degC = lambda true_degC: true_degC + kelvins

    return act


@pytest.mark.parametrize(
    ("shown", "kelvins"),
    [(Shown(), 10.0), (Shown("nac", 0.5, 0.02), -4.0), (Shown("phone", 1.0), 5.0), (Shown("dic", 0.1, 0.1), 3.0)],
    ids=["10 K", "-4 K in steps of 0.5 K", "5 K in steps of 1 K", "3 K and noise"],
)
def test_a_camera_that_is_wrong_for_40_s_is_suspect_for_40_s(shown: Shown, kelvins: float):
    """On a ramp and at rest; each reading in between, and the frame before the next reading."""
    chamber = CheckedChamber(2, shown, camera_powered=True)
    wrong: list[bool] = []
    qualities: list[Quality] = []

    def look() -> None:
        latest = chamber.hub.latest(CAMERA)
        assert latest is not None
        qualities.append(latest.quality)
        wrong.append(chamber.camera_degC(0.0) != 0.0)

    actions = [(900.0, lambda chamber: chamber.start(40.0)), (40.0, offset(kelvins)), (1800.0, offset(0.0))]
    actions += [(40.0, offset(kelvins)), (60.0, offset(0.0))]
    for _ in iterate_timed(chamber, actions):
        look()
    assert qualities == [Quality.STALE if each else Quality.GOOD for each in wrong]
    assert chamber.warnings == [("sensor_jumped", [CAMERA])] * 2
    assert [event.kind for event in chamber.messages if event.level == "info"] == ["sensor_believed"] * 2
    last = chamber.hub.latest(CAMERA)
    assert last is not None
    assert chamber.check.judge_value(CAMERA, last.value + kelvins, last.time_ns + to_ns(1)) != ""
    assert chamber.check.judge_value(CAMERA, last.value, last.time_ns + to_ns(2)) == ""


def module(attribute: str, value: object) -> Action:
    return lambda chamber: setattr(chamber.thermometers, attribute, value)


def exchange(chamber: Chamber) -> None:
    sensors = chamber.thermometers._sensors  # pyright: ignore[reportPrivateUsage] - the laboratory has no such fault
    air, laboratory = CHANNELS["air"], CHANNELS["laboratory"]
    sensors[air], sensors[laboratory] = sensors[laboratory], sensors[air]


@pytest.mark.parametrize(
    ("fault", "rule", "channels", "key"),
    [
        (module("type_codes", [0x22] * 6), "sensor_jumped", {f"thermometers.{name}" for name in CHANNELS}, "module"),
        (module("offset_K", {CHANNELS["air"]: 5.0}), "sensor_jumped", {AIR}, ""),
        (exchange, "sensor_jumped", {AIR, LABORATORY}, "exchanged"),
        (lambda chamber: setattr(chamber.regulator, "pv_offset_K", -5.0), "sensor_jumped", {PV}, ""),
        (module("stuck_degC", {CHANNELS["granite_inside"]: 24.5}), "sensor_stuck", {GRANITE}, ""),
    ],
    ids=["module of another range", "one channel", "exchanged cables", "regulator", "stuck"],
)
def test_what_moves_at_one_instant_is_one_event_that_names_what_they_share(
    fault: Action, rule: str, channels: set[str], key: str
):
    chamber = CheckedChamber(2, Shown(), camera_powered=True)
    for _ in iterate_timed(chamber, [(700.0, lambda chamber: chamber.start(40.0)), (1000.0, fault)]):
        pass
    found = next(event for event in chamber.messages if event.data["rule"] == rule)
    assert set(found.data["channels"]) == channels  # type: ignore[call-overload]
    assert {"module", "exchanged", "together_with"} & set(found.data) == ({key} if key else set())
    assert sum(rule == each for each, _ in chamber.warnings) == 1
    assert all((latest := chamber.hub.latest(name)) and latest.cause == "suspect" for name in channels)


class Fed:
    """A camera in air, fed by hand every 5 s."""

    def __init__(self, excess_K: tuple[float, float]) -> None:
        self.events: list[Event] = []
        natures = {AIR: ChannelModel((-40, 100)), CAMERA: ChannelModel((-40, 120), 600.0, AIR, excess_K)}
        check = ChannelCheck(natures, SensorsConfig(), self.events.append)
        self._marks = {name: check.make_marker(name) for name in natures}  # each a device of its own
        self._now_s = 0

    def run(self, duration_s: int, camera: Callable[[float], float], air: Callable[[float], float]) -> Reading:
        """The last reading of the camera."""
        last: Reading | None = None
        for second in range(0, duration_s, 5):
            now_ns = to_ns(self._now_s)
            readings = [(AIR, air(second) + (self._now_s // 5 % 3) * 0.003), (CAMERA, camera(second))]
            for name, value in readings:
                (last,) = self._marks[name]((Reading(name, value, "degC", now_ns),), now_ns)
            self._now_s += 5
        assert last is not None
        return last


@pytest.mark.parametrize(
    ("expected_K", "camera_degC", "is_suspect"),
    [((0.0, float("inf")), 16.0, True), ((0.0, float("inf")), 54.0, False), ((10.0, 25.0), 54.0, True)],
    ids=["colder than its air", "warm, nothing stated", "warmer than stated"],
)
def test_one_that_is_wrong_from_the_begin_is_found_where_physics_or_the_file_says_so(
    expected_K: tuple[float, float], camera_degC: float, is_suspect: bool
):
    fed = Fed(expected_K)
    assert fed.run(1700, lambda s: camera_degC, lambda s: 24.0).quality is Quality.GOOD
    last = fed.run(200, lambda s: camera_degC, lambda s: 24.0)
    assert (last.quality is Quality.STALE) is is_suspect
    assert [event.data["rule"] for event in fed.events] == (["sensor_implausible"] if is_suspect else [])


def test_a_display_at_rest_is_not_stuck_and_one_that_does_not_follow_the_air_is():
    fed = Fed((0.0, float("inf")))
    fed.run(60, lambda s: 44.0 + 0.5 * (s > 30), lambda s: 24.0)
    assert fed.run(9000, lambda s: 44.5, lambda s: 24.0).quality is Quality.GOOD
    assert fed.run(900, lambda s: 44.5, lambda s: min(36.0, 24 + s / 50)).quality is Quality.GOOD
    last = fed.run(600, lambda s: 44.5, lambda s: 36.0)
    assert (last.quality, last.cause) == (Quality.STALE, "suspect")
    assert fed.events[-1].data["rule"] == "sensor_stale"
    assert fed.run(10, lambda s: 50.0, lambda s: 36.0).quality is Quality.GOOD


def test_noise_is_one_message_and_outside_the_range_is_another():
    fed = Fed((0.0, float("inf")))
    fed.run(300, lambda s: 44.0, lambda s: 24.0)
    assert fed.run(300, lambda s: 44.0 + (0.9 if s % 10 else -0.9), lambda s: 24.0).quality is Quality.STALE
    assert fed.run(300, lambda s: 44.0, lambda s: 24.0).quality is Quality.GOOD
    assert [(event.kind, event.data["rule"]) for event in fed.events] == [
        ("guard.sensor_noisy", "sensor_noisy"),
        ("sensor_believed", "sensor_noisy"),
    ]
    fed = Fed((0.0, float("inf")))
    assert fed.run(10, lambda s: 150.0, lambda s: 24.0).quality is Quality.STALE
    assert fed.events[0].data["rule"] == "sensor_outside"
