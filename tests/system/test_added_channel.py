"""A channel that another package's device declares is found everywhere by its own name and unit."""

import asyncio
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml

from tests.addresses import find_free_port
from tests.installed import install, see_it_everywhere
from tests.recording.test_export import csv_rows
from tests.system.test_run import at_step
from thermostand.foundation.clock import VirtualClock
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError, NotReset, StandTripped
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Channel, Reading
from thermostand.recording.exporting.export import export
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.recorded_devices import recorded_devices
from thermostand.recording.reading.scan import verify
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.assembly.assemble import list_recorded_devices as declared_devices
from thermostand.stand.commands.sessions.session_text import format_info, make_info_json
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import Interrupted, resume, run_virtual
from thermostand.stand.serving.api.bridge import StateSnapshot
from thermostand.stand.serving.api.read_routes import format_metrics
from thermostand.stand.serving.api_models import snapshot_state
from thermostand.stand.serving.recorded_history import read_session_columns

MODULE = '''
"""A weather station that answers a line: `?` -> `1013.2 11.5 0.25 3.4`; a value that it has not is `-`."""

import math
from typing import Literal

from thermostand.drivers.devices.kinds import DeviceKind
from thermostand.drivers.settings import Identity, Polled
from thermostand.drivers.wires.line_client import LineClient
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.addresses import ByteAddress
from thermostand.foundation.workers import WorkerThread
from thermostand.foundation.readings import Channel, Reading, bad_reading

CHANNELS = (
    Channel("pressure", "hPa", "pressure"),
    Channel("dew", "degC", "temperature"),
    Channel("ratio", ""),
    Channel("flow", "l/min", "flow"),
    Channel("rain", "mm/h", "rain"),
)


class Settings(Polled):
    kind: Literal["station"]
    address: ByteAddress


class Station:
    def __init__(self, name, settings, clock):
        self.name, self.identity, self._clock, self._lane = name, None, clock, None
        self._client = LineClient.at(name, settings.address, SerialSettings(9600, 1), (1.0, 0.0))

    async def _ask(self):
        def whole(data):
            return data.decode() if data.endswith(b"\\n") else None

        return (await self._lane.call(self._client.query, b"?\\n", whole)).split()

    async def open(self):
        self._lane = self._lane or WorkerThread(self.name, self._clock)
        await self._ask()
        self.identity = Identity("Acme", "W1", "7", "")

    async def close(self):
        lane, self._lane = self._lane, None
        if lane is not None:
            await lane.call(self._client.close)
            lane.close()

    async def read(self):
        now_ns = self._clock.now_ns()
        return tuple(
            bad_reading(f"{self.name}.{each.name}", each.unit, now_ns, "no sensor")
            if text == "-"
            else Reading(f"{self.name}.{each.name}", float(text), each.unit, now_ns)
            for each, text in zip(CHANNELS, await self._ask(), strict=True)
        )


KIND = DeviceKind(
    name="station",
    settings=Settings,
    make=lambda name, settings, around: Station(name, settings, around.clock),
    channels=CHANNELS,
)
'''
FAKE = """
from thermostand.drivers.sim.wire import LineEngine


class Station:
    def __init__(self, bench, name, settings):
        self.asked = 0
        bench.listen(name, settings["address"], lambda: LineEngine(self.answer))

    def answer(self, line):
        self.asked += 1
        return b"1013.2 11.5 0.25 " + (b"-" if self.asked % 5 == 0 else b"3.4") + b" -"
"""
RECIPE = """
name: short
experiments:
  - steps: [{start_chamber: 24}, {soak: 120}]
"""


def lab() -> dict[str, object]:
    """In a stand's file."""
    return {"kind": "station", "address": f"tcp:127.0.0.1:{find_free_port()}"}


VALUES = {"pressure": 1013.2, "dew": 11.5, "ratio": 0.25, "flow": 3.4}
UNITS = {"lab.pressure": "hPa", "lab.dew": "degC", "lab.ratio": "", "lab.flow": "l/min", "lab.rain": "mm/h"}


@pytest.fixture
def station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], None]]:
    """The package, installed, for this process and those that it starts. Called, it changes the package's text."""
    folder = tmp_path / "site"
    points = {"thermostand.devices": "station = acme_station:KIND", "thermostand.fakes": "station = acme_fake:Station"}
    install(folder, "acme-station", {"acme_station": MODULE, "acme_fake": FAKE}, points)
    see_it_everywhere(folder, monkeypatch)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def changed(was: str, now: str) -> None:
        (folder / "acme_station.py").write_text(MODULE.replace(was, now))
        sys.modules.pop("acme_station", None)

    yield changed
    sys.modules.pop("acme_station", None)


def stand_with(**changes: Any) -> StandConfig:
    data: dict[str, Any] = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["devices"] = {"lab": lab()}
    data["guard"] = {**data.get("guard", {}), **changes}
    return parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")


@pytest.mark.usefixtures("station")
async def test_it_is_recorded_exported_and_drawn_by_its_own_name_and_unit(tmp_path: Path, order: Callable[..., Order]):
    session = Session.open(
        await run_virtual(order(RECIPE, devices={"lab": lab()}), tmp_path / "out", None, lambda _: None)
    )
    declared = recorded_devices(session.telemetry_segments)["lab"]
    assert (declared.kind, declared.channels) == (
        "station",
        (
            Channel("pressure", "hPa", "pressure"),
            Channel("dew", "degC", "temperature"),
            Channel("ratio", ""),
            Channel("flow", "l/min", "flow"),
            Channel("rain", "mm/h", "rain"),
        ),
    )
    assert {channel: unit for channel, unit in session.units().items() if channel.startswith("lab.")} == UNITS
    for name, value in VALUES.items():
        times_ns, values = session.readings(f"lab.{name}")
        assert len(times_ns) > 10
        assert set(values[~np.isnan(values)]) == {value}
    flow = session.readings("lab.flow")[1]
    assert 0 < np.isnan(flow).sum() < len(flow), "each fifth is BAD, and NaN exactly there"
    export(session, tmp_path / "exported", report=lambda done, text: None)
    rows = csv_rows(tmp_path / "exported/telemetry/lab.csv")
    assert [name for name in rows[0] if "quality" not in name][2:] == [
        "pressure_hPa",
        "dew_degC",
        "ratio",
        "flow_l_per_min",
        "rain_mm_per_h",
        "remarks",
    ]
    assert {(row["pressure_hPa"], row["ratio"], row["flow_l_per_min_quality"]) for row in rows} == {
        ("1013.2", "0.25", "good"),
        ("1013.2", "0.25", "bad"),
    }
    history = read_session_columns(session.path, 200)
    assert {channel: history.units[channel] for channel in UNITS} == UNITS
    assert {round(value, 1) for value in history.low["lab.pressure"].tolist() if value == value} == {1013.2}
    seen = summarise_session(session.path)
    ranges = {row["channel"]: row for row in cast("list[dict[str, Any]]", make_info_json(seen)["channels"])}
    assert {name: ranges[name]["unit"] for name in UNITS} == UNITS
    assert (ranges["lab.pressure"]["min"], ranges["lab.pressure"]["max"], ranges["lab.rain"]["max"]) == (
        1013.2,
        1013.2,
        None,
    )
    assert any("lab.flow l/min" in line for line in format_info(seen))
    checked = verify(session.path)
    assert checked.is_sound
    assert [each.text for each in checked.findings if "though it was declared" in each.text] == []


@pytest.mark.usefixtures("station")
async def test_it_is_among_the_metrics_with_its_unit():
    hub, clock, config = Hub(), VirtualClock(0), stand_with()
    stand = assemble(config, hub, clock).stand
    declared = declared_devices(config)["lab"].channels
    readings = (Reading(f"lab.{each.name}", VALUES.get(each.name, 0.5), each.unit, 0) for each in declared)
    hub.publish(Batch("lab", 0, tuple(readings)))
    text = format_metrics(StateSnapshot(snapshot_state(config, stand, hub, clock), 0.0), 0, 0)
    for channel, unit in UNITS.items():
        assert f'thermostand_reading{{channel="{channel}",unit="{unit}"}} ' in text
    await stand.safety.close()


def test_a_unit_that_has_changed_when_a_run_is_resumed_is_an_event_and_its_readings_are_kept_apart(
    tmp_path: Path, order: Callable[..., Order], station: Callable[[str, str], None]
):
    ordered = order(RECIPE, devices={"lab": lab()})
    stop = at_step("soak", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(Interrupted):
        asyncio.run(run_virtual(ordered, tmp_path / "out", None, stop))
    (directory,) = (tmp_path / "out").iterdir()
    station('"hPa"', '"mbar"')
    asyncio.run(resume(load_interruption(directory), lambda hub: None))
    session = Session.open(directory)
    (differs,) = [each.data for each in session.events() if each.kind == "stand_differs"]
    assert (differs["path"], differs["session"], differs["stand"]) == ("the unit of lab.pressure", "hPa", "mbar")
    pressures = {channel: unit for channel, unit in session.units().items() if channel.startswith("lab.pressure")}
    assert pressures == {"lab.pressure": "hPa", "lab.pressure (mbar)": "mbar"}
    ranges = {each.channel: each.count for each in summarise_session(directory).channels}
    for channel in pressures:
        assert 0 < len(session.readings(channel)[0]) == ranges[channel]
    assert verify(directory).is_sound


OUTSIDE = "guard.channel_limit"
SILENT = "guard.channel_silent"


@pytest.mark.usefixtures("station")
@pytest.mark.parametrize(
    ("channel", "limits", "kind", "shown", "action"),
    [
        ("lab.pressure", {"lowest": 900, "highest": 1100}, None, "", ""),
        ("lab.flow", {"lowest": 3, "highest": 4}, None, "", ""),  # each fifth reading is missing
        ("lab.pressure", {"highest": 1000}, OUTSIDE, "1013.2 hPa", "warn"),
        ("lab.ratio", {"lowest": 0.5, "action": "trip"}, OUTSIDE, "0.25,", "abort"),
        ("lab.rain", {"highest": 1}, SILENT, "no sensor", "warn"),
        ("lab.rain", {"highest": 1, "action": "trip"}, SILENT, "no sensor", "hold"),
    ],
)
async def test_a_limit_is_set_on_it(
    tmp_path: Path,
    order: Callable[..., Order],
    channel: str,
    limits: dict[str, Any],
    kind: str | None,
    shown: str,
    action: str,
):
    seen: list[Event] = []

    def watch(hub: Hub) -> None:
        hub.subscribe(lambda item: seen.append(item) if isinstance(item, Event) else None)

    guard = {"channels": {channel: {"after_s": 20, **limits}}}
    run = run_virtual(order(RECIPE, devices={"lab": lab()}, guard=guard), tmp_path / "out", None, watch)
    if action in ("abort", "hold"):
        with pytest.raises(StandTripped if action == "abort" else NotReset):
            await run
    else:
        await run
    found = [event for event in seen if event.kind in (OUTSIDE, SILENT)][:1]
    assert [(event.kind, event.data["action"]) for event in found] == ([(kind, action)] if kind else [])
    assert all(channel in event.text and shown in event.text for event in found)


@pytest.mark.usefixtures("station")
@pytest.mark.parametrize(
    ("limited", "sentence"),
    [
        ({"lab.presure": {"highest": 1}}, r"no device .* measures lab.presure; did you mean lab.pressure\?"),
        ({"lab.pressure": {"highest": 1, "after_s": 1}}, "lab.pressure.after_s must be at least twice the poll_s"),
        ({"lab.pressure": {"lowest": 2, "highest": 1}}, "lowest 2 is not below highest 1"),
        ({"lab.pressure": {}}, "needs lowest, highest or both"),
        ({"lab.pressure": {"highest": 1, "action": "cry"}}, "guard.channels.lab.pressure.action"),
    ],
)
def test_limits_that_do_not_fit_are_refused(limited: dict[str, Any], sentence: str):
    with pytest.raises(ConfigError, match=sentence):
        assemble(stand_with(channels=limited), Hub(), VirtualClock(0))


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "air pressure",
            "lab: its kind station declares the channel 'air pressure', and a channel's name",
        ),
        ("a.b", "'a.b', and a channel's name is of letters"),
        ("", "'', and a channel's name is of letters"),
        ("dew", "declares the channel 'dew', twice; a channel has one name and one unit: correct the package"),
    ],
)
def test_names_that_cannot_be_found_again_are_refused(station: Callable[[str, str], None], name: str, sentence: str):
    station('Channel("pressure"', f'Channel("{name}"')
    with pytest.raises(ConfigError, match=sentence):
        declared_devices(stand_with())


@pytest.mark.usefixtures("station")
def test_two_devices_of_one_name_are_refused():
    data: dict[str, Any] = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["devices"] = {"camera": lab()}
    with pytest.raises(ConfigError, match="the name camera"):
        parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")
