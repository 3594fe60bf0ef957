"""The thermal imager's folder: pictures that arrive whole, half, twice, from elsewhere, or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.still_plant import StillPlant
from thermostand.drivers.devices.imager.thermal_imager import SpotSettings, ThermalImager, ThermalImagerSettings
from thermostand.drivers.sim.units.thermal_imager import FakeThermalImager
from thermostand.foundation.clock import NS_PER_S, VirtualClock, to_ns
from thermostand.foundation.items import Event, Item, Original
from thermostand.foundation.readings import Quality, Reading

START_NS = 1_800_000_000 * NS_PER_S
SPOTS = {"lens": (80, 60), "housing": (40, 30), "back": (120, 90)}


class HandClock(VirtualClock):
    """Virtual time by hand: nothing sleeps here."""

    def step(self, duration_s: float) -> None:
        self._now_ns += to_ns(duration_s)


class Bench:
    def __init__(self, folder: Path, **settings: object) -> None:
        self.clock = HandClock(START_NS)
        self.sight = StillPlant(START_NS, chamber=30.0, lens=41.0, body=45.0, sensor=55.0)
        self.fake = FakeThermalImager(self.sight, folder, SPOTS, seed=1)
        spots = {name: SpotSettings(x_px=x, y_px=y) for name, (x, y) in SPOTS.items()}
        known = {"folder": folder, "spots": spots, "stale_after_s": 300.0, **settings}
        self.items: list[Item] = []
        self.imager = ThermalImager(
            "imager", ThermalImagerSettings.model_validate(known), self.clock, self.items.append
        )
        self.reported: dict[str, Reading] = {}

    async def wait(self, duration_s: float) -> dict[str, Reading]:
        """The latest readings, looked for every 2 s."""
        for _ in range(round(duration_s / 2)):
            self.clock.step(2.0)
            for step in self.sight.on_step:
                step(self.clock.now_ns(), 2.0)
            self.reported |= {reading.channel.partition(".")[2]: reading for reading in await self.imager.read()}
        return self.reported

    def events(self, kind: str) -> list[Event]:
        return [item for item in self.items if isinstance(item, Event) and item.kind == kind]

    def originals(self) -> list[Original]:
        return [item for item in self.items if isinstance(item, Original)]


@pytest.fixture
async def bench(tmp_path: Path):
    bench = Bench(tmp_path / "imager")
    await bench.imager.open()
    yield bench
    await bench.imager.close()


async def test_each_picture_gives_its_spots_and_itself(bench: Bench) -> None:
    readings = await bench.wait(40)
    assert {reading.reason for reading in readings.values()} == {"no picture yet"}
    readings = await bench.wait(40)
    assert {name: round(readings[name].value, 1) for name in SPOTS} == {"lens": 41.0, "housing": 48.0, "back": 45.0}
    assert all(reading.quality is Quality.GOOD for reading in readings.values())
    assert bench.clock.now_ns() - readings["lens"].time_ns < to_ns(40)
    (original,) = bench.originals()
    assert original.data == (bench.fake.folder / original.name).read_bytes()
    (taken,) = bench.events("picture_taken")
    assert (taken.data["model"], taken.data["serial_number"]) == ("FLIR E40", "49001234")
    assert taken.data["emissivity"] == dict.fromkeys(SPOTS, 0.95)


async def test_a_reading_is_reported_once(bench: Bench) -> None:
    await bench.wait(80)
    before = bench.reported["lens"]
    bench.reported.clear()
    await bench.wait(20)
    assert bench.reported == {}
    await bench.wait(60)
    assert bench.reported["lens"].time_ns > before.time_ns


async def test_half_a_file_waits_for_its_other_half(bench: Bench) -> None:
    bench.fake.cut = True
    await bench.wait(100)
    assert bench.items == []
    assert bench.reported["lens"].quality is Quality.BAD
    bench.fake.cut = False
    await bench.wait(10)
    assert [original.name for original in bench.originals()] == ["FLIR0001.jpg"]
    assert bench.events("picture_left_out") == []


async def test_a_file_that_is_never_completed_is_left_out_until_it_changes(bench: Bench) -> None:
    bench.fake.cut = True
    await bench.wait(64)
    bench.fake.stopped = True
    await bench.wait(80)
    (left_out,) = bench.events("picture_left_out")
    assert "its end is missing" in str(left_out.data["reason"])
    bench.fake.cut = False
    await bench.wait(10)
    assert [original.name for original in bench.originals()] == ["FLIR0001.jpg"]


@pytest.mark.parametrize(
    ("fault", "value", "reason"),
    [
        ("plain", True, "without temperatures"),
        ("damaged", True, "ends behind the block"),
        ("serial_number", "49009999", "imager 49009999"),
    ],
)
async def test_a_bad_picture_is_left_out_and_left_alone(fault: str, value: object, reason: str, tmp_path: Path) -> None:
    bench = Bench(tmp_path / "imager", serial_number="49001234")
    await bench.imager.open()
    sound = getattr(bench.fake, fault)
    setattr(bench.fake, fault, value)
    await bench.wait(100)
    (event,) = bench.events("picture_left_out")
    assert reason in str(event.data["reason"])
    assert (bench.fake.folder / "FLIR0001.jpg").exists()
    assert bench.reported["lens"].quality is Quality.BAD
    setattr(bench.fake, fault, sound)
    await bench.wait(60)
    assert bench.reported["lens"].quality is Quality.GOOD
    await bench.imager.close()


async def test_the_same_picture_under_a_new_name_counts_once(bench: Bench) -> None:
    await bench.wait(80)
    bench.fake.again = True
    await bench.wait(120)
    assert len(list(bench.fake.folder.iterdir())) == 3
    assert len(bench.originals()) == 1
    assert bench.events("picture_left_out") == []


@pytest.mark.parametrize("ahead_s", [0.0, 3600.0, -7200.0])
async def test_a_wrong_clock_is_reported_and_set_right(bench: Bench, ahead_s: float) -> None:
    bench.fake.clock_s = ahead_s
    readings = await bench.wait(80)
    taken_ns = START_NS + to_ns(62.0)
    assert readings["clock_offset"].value == pytest.approx(-ahead_s, abs=2.5)
    assert abs(readings["lens"].time_ns - taken_ns) < to_ns(2.5)
    assert bench.events("picture_taken")[0].data["camera_s"] == pytest.approx(taken_ns / NS_PER_S + ahead_s, abs=2.5)


@pytest.mark.parametrize("back_s", [300.0, 7200.0])
async def test_a_clock_that_is_set_back_on_the_way_costs_one_picture_and_is_reported(
    bench: Bench, back_s: float
) -> None:
    await bench.wait(80)
    bench.fake.clock_s = -back_s
    await bench.wait(60)
    assert bench.events("clock_set_back") == []  # one alone may be an old picture
    readings = await bench.wait(60)
    assert [event.data["by_s"] for event in bench.events("clock_set_back")] == [pytest.approx(back_s, abs=3)]
    assert readings["clock_offset"].value == pytest.approx(back_s, abs=2.5)
    assert abs(readings["lens"].time_ns - START_NS - to_ns(182.0)) < to_ns(2.5)
    assert readings["lens"].quality is Quality.GOOD
    await bench.wait(600)
    assert len(bench.events("clock_set_back")) == 1
    assert bench.events("no_picture") == []


async def test_old_pictures_that_are_copied_into_the_folder_do_not_set_its_clock(bench: Bench, tmp_path: Path) -> None:
    """Three of an hour ago, a minute apart, that come within some seconds."""
    other = FakeThermalImager(bench.sight, tmp_path / "card", SPOTS, seed=2)
    other.clock_s = -3600.0
    await bench.wait(220)
    bench.fake.stopped = other.stopped = True
    for number, old in enumerate(sorted(other.folder.iterdir())):
        (bench.fake.folder / f"OLD_{number}.jpg").write_bytes(old.read_bytes())
        await bench.wait(6)
    before = bench.reported["clock_offset"].value
    bench.fake.stopped = False
    readings = await bench.wait(120)
    assert len(bench.originals()) >= 7
    assert bench.events("clock_set_back") == []
    assert readings["clock_offset"].value == pytest.approx(before, abs=2.5)


async def test_without_new_pictures_the_last_ones_become_suspect(bench: Bench) -> None:
    await bench.wait(80)
    bench.fake.stopped = True
    readings = await bench.wait(320)
    assert {reading.quality for reading in readings.values()} == {Quality.STALE}
    assert len(bench.events("no_picture")) == 1
    bench.fake.stopped = False
    readings = await bench.wait(80)
    assert readings["lens"].quality is Quality.GOOD


async def test_a_folder_that_goes_and_comes_is_reported_and_read_again(bench: Bench) -> None:
    await bench.wait(80)
    bench.fake.unplugged = True
    readings = await bench.wait(10)
    assert {reading.quality for reading in readings.values()} == {Quality.BAD}
    assert "is it mounted?" in readings["lens"].reason
    bench.fake.unplugged = False
    readings = await bench.wait(10)
    assert readings["lens"].quality is Quality.GOOD
    assert [len(bench.events(kind)) for kind in ("pictures_lost", "pictures_back", "picture_taken")] == [1, 1, 1]


async def test_pictures_from_before_are_of_another_session(tmp_path: Path) -> None:
    before = Bench(tmp_path / "imager")
    await before.imager.open()
    await before.wait(80)
    later = Bench(tmp_path / "imager")
    await later.imager.open()
    await later.wait(20)
    assert later.items == []
    for bench in (before, later):
        await bench.imager.close()


async def test_a_spot_by_the_imagers_own_label_and_one_outside_the_picture(tmp_path: Path) -> None:
    spots = {
        "lens": SpotSettings(x_px=5, y_px=5, label="lens"),
        "far": SpotSettings(x_px=159, y_px=60),
    }
    bench = Bench(tmp_path / "imager", spots=spots)
    bench.fake.labels = {"lens": SPOTS["lens"]}
    await bench.imager.open()
    readings = await bench.wait(80)
    assert readings["lens"].value == pytest.approx(41.0, abs=0.2)
    assert readings["far"].reason == "(159, 60) is not within the 160 x 120 px"
    await bench.imager.close()


async def test_a_spot_of_the_imager_without_a_label_moves_none_of_ours(bench: Bench) -> None:
    bench.fake.labels = {"": (5, 5)}
    readings = await bench.wait(80)
    assert readings["lens"].value == pytest.approx(41.0, abs=0.2)


async def test_the_imager_says_which_software_it_has(bench: Bench) -> None:
    await bench.wait(80)
    assert bench.imager.identity is not None
    assert (bench.imager.identity.model, bench.imager.identity.version) == ("E40", "4.2")
