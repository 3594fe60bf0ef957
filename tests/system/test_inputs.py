"""Contacts of the stand on digital inputs, over the wire in virtual time: a door that opens holds the run or ends it, a
contact that only warns does neither, and each is recorded."""

from pathlib import Path

import pytest
import yaml

from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import ConfigError, StandError, StandTripped
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.guarding.rules import Announcements, make_watches
from thermostand.stand.running.order import load_order
from thermostand.stand.service.run import run_virtual

STEPS = """
name: rest
steps:
  - start_chamber: 26
  - soak: 300
  - stop_chamber
"""


def stand(folder: Path, action: str, unit: int, *faults: str, **changes: object) -> Path:
    """A simulated stand without a camera, with a door on input 2 and a key switch on input 0."""
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["cameras"], data["axes"] = {}, {}
    door = {"channel": 2, "action": action, "means": "the chamber's door", **changes}
    key = {"channel": 0, "fault_when": "closed", "action": "warn"}
    data["inputs"] = {"registers": "waveshare-inputs", "unit": unit, "contacts": {"door": door, "key": key}}
    data["simulation"]["faults"] = list(faults)
    (folder / "stand.yaml").write_text(yaml.safe_dump(data))
    (folder / "rest.yaml").write_text(STEPS)
    return folder / "stand.yaml"


async def run_session(folder: Path, config: Path) -> tuple[Session, list[Event], str]:
    """The session, its events, and how the run ended."""
    seen: list[Event] = []
    order = load_order(str(folder / "rest.yaml"), str(config))

    def follow(item: Item) -> None:
        if isinstance(item, Event):
            seen.append(item)

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)

    ended = "complete"
    try:
        await run_virtual(order, folder / "out", None, watch)
    except StandError as error:
        ended = f"{type(error).__name__}: {error}"
    (directory,) = (path for path in (folder / "out").iterdir() if path.is_dir())
    return Session.open(directory), seen, ended


@pytest.mark.parametrize("unit", [2, 7])
async def test_an_open_door_ends_the_run_where_it_is_to_trip(tmp_path: Path, unit: int):
    session, seen, ended = await run_session(tmp_path, stand(tmp_path, "trip", unit, "inputs.changed=door@100"))
    assert ended.startswith(StandTripped.__name__)
    (trip,) = (event for event in seen if event.kind == "guard.contact")
    assert (trip.text.partition(":")[0], trip.data["action"]) == ("inputs.door is open", "abort")
    times_ns, values = session.readings("inputs.door")
    assert (values[0], values[-1]) == (1.0, 0.0)
    assert times_ns[values == 0][0] - times_ns[0] == pytest.approx(100e9, abs=60e9)
    assert session.readings("relays.heater_enable")[1][-1] == 0.0
    assert "registers-inputs.yaml" in session.attachments


async def test_a_contact_that_only_warns_leaves_the_run_alone(tmp_path: Path):
    _, seen, ended = await run_session(tmp_path, stand(tmp_path, "trip", 2, "inputs.changed=key@100:60"))
    assert ended == "complete"
    (warned,) = (event for event in seen if event.kind == "guard.contact")
    assert (warned.level, warned.text) == ("warning", "inputs.key is closed")


async def test_a_door_that_is_opened_for_less_than_it_may_is_nothing(tmp_path: Path):
    config = stand(tmp_path, "trip", 2, "inputs.changed=door@100:10", after_s=30)
    _, seen, ended = await run_session(tmp_path, config)
    assert (ended, [event for event in seen if event.kind == "guard.contact"]) == ("complete", [])


@pytest.mark.parametrize(("action", "done"), [("hold", "hold"), ("trip", "abort"), ("warn", "warn")])
def test_a_contact_that_is_lost_holds_and_ends_no_run(tmp_path: Path, action: str, done: str):
    config, hub = load_config(stand(tmp_path, action, 2)), Hub()
    rules = make_watches(config, Announcements())

    def faults(at_s: int, reading: Reading) -> list[tuple[str, str]]:
        hub.publish(Batch("inputs", reading.time_ns, (reading,)))
        found = [fault for watch in rules if (fault := watch.check(hub, to_ns(at_s))) is not None]
        return [(fault.rule, fault.action) for fault in found if "inputs.door" in fault.text]

    assert faults(1, Reading("inputs.door", 1.0, "1", to_ns(1))) == []
    assert faults(2, Reading("inputs.door", 0.0, "1", to_ns(2))) == [("contact", done)]
    assert faults(3, Reading("inputs.door", 1.0, "1", to_ns(3))) == []
    lost = bad_reading("inputs.door", "1", to_ns(30), "no reply", "wire")
    assert faults(30, lost) == [("sensor_bad", "warn" if action == "warn" else "hold")]


def test_what_cannot_be_is_refused_with_a_sentence(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"inputs.unit is that"):
        load_config(stand(tmp_path, "hold", 1))
    with pytest.raises(ConfigError, match="share one input"):
        load_config(stand(tmp_path, "hold", 2, channel=0))
    path = stand(tmp_path, "hold", 2)
    path.write_text(path.read_text().replace("waveshare-inputs", "waveshare-relay"))
    with pytest.raises(ConfigError, match=r"inputs.door: register map .* has no input_2"):
        load_order(str(tmp_path / "rest.yaml"), str(path))
