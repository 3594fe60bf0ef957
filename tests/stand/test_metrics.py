"""The page for Prometheus, and the dashboard that asks for what is on it."""

import importlib.resources
import json
import re
from pathlib import Path

from tests.stand.fake_service import FakeService
from tests.stand.test_interface import STATUS
from thermostand.stand.serving.api.bridge import Bridge, StateSnapshot
from thermostand.stand.serving.api.read_routes import format_metrics
from thermostand.stand.serving.api_models import FaultState, HeatByHand, QueuedRun

_SAMPLE = re.compile(r'(thermostand_[a-z_]+)(\{([a-z_]+="(\\.|[^"\\\n])*",?)*\})? (-?[0-9.e+-]+)')


async def page() -> str:
    desk = FakeService("operator", run=STATUS.model_copy(update={"end_ns": STATUS.now_ns + 60_000_000_000}))
    bridge = Bridge(desk)
    state = bridge.snapshot.state.model_copy(
        update={
            "stand": 'a "stand"\nof \\ours',
            "fault": FaultState(rule="over_temperature", text="too hot", since_ns=1),
            "setpoint_degC": 30.0,
            "by_hand": HeatByHand(setpoint_degC=40.0, since_ns=bridge.snapshot.state.now_ns - 60_000_000_000),
            "output_percent": -12.5,
            "counters": {"compressor_hours": 12.5},
            "queue": (QueuedRun(id=1, recipe="r", state="waiting", added_ns=1),),
        }
    )
    bridge.close()
    return format_metrics(StateSnapshot(state, bridge.snapshot.at_s), 3, 2)


async def test_every_line_is_of_the_format_and_no_measurement_is_invented():
    text = await page()
    assert text.endswith("\n")
    values = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            found = _SAMPLE.fullmatch(line)
            assert found is not None, line
            values[line.rpartition(" ")[0]] = float(found[5])
    assert values['thermostand_reading{channel="thermometers.air",unit="degC"}'] == 21.5
    assert not any(name.startswith('thermostand_reading{channel="thermometers.granite"') for name in values)
    assert values['thermostand_reading_bad{channel="thermometers.granite"}'] == 1
    assert values['thermostand_phase{phase="held"}'] == 1
    assert values['thermostand_hold{reason="operator"}'] == 1
    assert values["thermostand_left_seconds"] == 60
    assert values["thermostand_by_hand_setpoint_celsius"] == 40
    assert values["thermostand_by_hand_seconds"] == 60
    assert values["thermostand_output_percent"] == -12.5
    assert values["thermostand_interface_drops_total"] == 3
    assert r'stand="a \"stand\"\nof \\ours"' in text


async def test_the_dashboard_asks_for_existing_metrics():
    text = await page()
    dashboard = json.loads(Path(str(importlib.resources.files("thermostand.configs") / "grafana.json")).read_text())
    asked = {
        name
        for panel in dashboard["panels"]
        for target in panel["targets"]
        for name in re.findall(r"thermostand_[a-z_]+", target["expr"])
    }
    assert asked
    assert asked <= set(re.findall(r"^# TYPE (\S+)", text, re.MULTILINE))
