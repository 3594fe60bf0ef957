"""A rule of the guard that another package adds is found everywhere by its one file."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.installed import install
from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import GUARD, KINDS, Alert, make_alert
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Reading
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.commands.remedies import get_next_command, make_troubleshooting_page
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.safety.fault import Fault

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "ambient-rule"
MODULE = (EXAMPLE / "acme_ambient.py").read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def ambient_hot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package, installed; nothing of this program knows it."""
    monkeypatch.syspath_prepend(tmp_path)
    points = "ambient_hot = acme_ambient:RULE\nambient_cold = acme_none:RULE\nambient_wet = acme_ambient:RULE"
    install(tmp_path, "acme-ambient", {"acme_ambient": MODULE}, {"thermostand.guard_rules": points})
    yield
    KINDS.pop(f"{GUARD}ambient_hot", None)
    sys.modules.pop("acme_ambient", None)


def config_with(**added: object) -> StandConfig:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["guard"]["added"] = added
    return parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")


def test_the_stands_file_has_its_settings_checked_and_written_again():
    config = config_with(ambient_hot={"limit_degC": 28.0})
    assert config.model_dump()["guard"]["added"] == {"ambient_hot": {"limit_degC": 28.0, "for_s": 0.0}}
    assert config_with(ambient_hot=None).model_dump()["guard"]["added"]["ambient_hot"]["limit_degC"] == 30.0


@pytest.mark.parametrize(
    ("added", "sentence"),
    [
        ({"ambient_hot": {"limit_degC": 50}}, "guard.added: limit_degC: must be less than or equal to 40"),
        ({"ambient_hot": {"limit": 30}}, r"guard.added: .*limit"),
        (
            {"too_dark": {}},
            r"guard.added: no package adds a rule 'too_dark'; there are ambient_cold, ambient_hot, ambient_wet",
        ),
        ({"ambient_cold": {}}, r"guard.added: ambient_cold: acme-ambient 1.0 cannot be loaded .*; reinstall it"),
        ({"ambient_wet": {}}, "guard.added: ambient_wet: acme-ambient 1.0 has no GuardRule of that name there"),
    ],
)
def test_what_is_wrong_with_it_is_reported(added: dict[str, object], sentence: str):
    with pytest.raises(ConfigError, match=sentence):
        config_with(**added)


async def test_it_trips_and_its_event_has_advice_alert_and_row():
    config, hub, clock = config_with(ambient_hot={"limit_degC": 28.0}), Hub(), VirtualClock(0)
    assembly, held, published = assemble(config, hub, clock), list[Fault](), list[Event]()
    hub.subscribe(lambda item: published.append(item) if isinstance(item, Event) else None)
    guard = assembly.make_guard(held.append, held.append)
    (watch,) = [each for each in guard.watches if each.rule.__module__ == "acme_ambient"]
    guard.watches = (watch,)
    for degC, trips in ((27.0, []), (29.0, ["ambient_hot"])):
        reading = Reading("thermometers.laboratory", degC, "degC", to_ns(1))
        hub.publish(Batch("thermometers", to_ns(1), (reading,)))
        guard.look()
        assert [fault.rule for fault in held] == trips
    assert assembly.stand.latch.fault == held[0]
    (trip,) = [event for event in published if event.kind == f"{GUARD}ambient_hot"]
    assert (trip.level, trip.text, make_alert(trip)) == (
        "error",
        f"the laboratory of {config.name} is 29.0 degC",
        Alert("hold", "guard", "lasting"),
    )
    assert get_next_command(trip.kind, trip.data)
    (row,) = [
        line
        for line in make_troubleshooting_page().splitlines()
        if line.startswith("| `guard.ambient_hot` that only warns")
    ]
    assert row.split(" | ")[1] == "warning"
    await assembly.stand.safety.close()
