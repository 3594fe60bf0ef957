"""A camera that goes on showing its last temperature: it is recorded, but not as a measurement of now."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.system.conftest import SHORT_RECIPE
from tests.system.test_run import at_step
from tests.system.test_run_ends import break_now
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Quality
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual


async def test_a_frozen_camera_temperature_is_stale_in_the_recording(tmp_path: Path, order: Callable[..., Order]):
    ordered = order(SHORT_RECIPE)
    watch = at_step("soak", lambda: break_now(ordered, "camera.frozen_temperature", True))
    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, watch))
    batches = [item for item in session.items() if isinstance(item, Batch)]
    readings = [each for batch in batches for each in batch.readings if each.channel == "camera.temperature"]
    stale = [reading for reading in readings if reading.quality is Quality.STALE]
    assert stale
    assert "camera.temperature stays at" in stale[0].reason
    assert {reading.value for reading in stale} == {stale[0].value}
    assert all(reading.quality is Quality.STALE for reading in readings if reading.time_ns >= stale[0].time_ns)
    before = [reading for reading in readings if reading.time_ns < stale[0].time_ns]
    assert {reading.quality for reading in before} == {Quality.GOOD}
    air_ns, air_degC = session.readings("thermometers.air")
    frozen_ns = next(reading.time_ns for reading in before if reading.value == stale[0].value)
    assert np.ptp(air_degC[(air_ns >= frozen_ns) & (air_ns <= stale[0].time_ns)]) >= 3.0
    (warned,) = [event for event in session.events() if event.kind == "guard.sensor_stale"]
    assert 0 <= warned.time_ns - stale[0].time_ns <= 2e9
