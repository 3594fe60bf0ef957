"""Anybody's stand in virtual time: limits, thermometers, axes, contacts and recipe are kept, the devices simulated."""

from pathlib import Path

import pytest
import yaml

from thermostand.foundation.errors import ConfigError
from thermostand.recording.reading.run_status import RunOutcome
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.order import load_order
from thermostand.stand.service.run import make_rehearsal, run_virtual

RECIPE = "name: short\nsteps:\n  - start_chamber: 26\n  - soak: 300\n  - stop_chamber\n"


def real_stand(folder: Path, **changes: object) -> Path:
    """The installed laboratory's file with a few things that only this one has, and no camera."""
    data = yaml.safe_load(find_packaged("", "laboratory").read_text())
    data["limits"]["chamber_degC"] = [12, 48]
    data["alerts"] = {"command": ["/bin/true"]}
    data |= {"cameras": {}, **changes}
    (folder / "stand.yaml").write_text(yaml.safe_dump(data))
    (folder / "short.yaml").write_text(RECIPE)
    return folder / "stand.yaml"


async def test_the_rehearsal_of_a_real_stand_runs_and_is_recorded_as_simulated(tmp_path: Path):
    order = load_order(str(tmp_path / "short.yaml"), str(real_stand(tmp_path)))
    session = Session.open(await run_virtual(order, tmp_path / "out", 3, lambda hub: None))
    assert (session.run, session.metadata["simulated"]) == (RunOutcome.COMPLETE, "true")
    attached = StandConfig.model_validate(yaml.safe_load(session.attachments["config.yaml"]))
    assert attached.simulation is not None
    assert attached.limits.chamber_degC == (12, 48)
    assert attached.thermometers == order.config.thermometers
    assert session.attachments["config.yaml"].startswith("# A rehearsal")


def test_what_is_kept_and_what_is_replaced(tmp_path: Path):
    laboratory = yaml.safe_load(find_packaged("", "laboratory").read_text())
    path = real_stand(tmp_path, cameras=laboratory["cameras"])
    order = load_order(str(tmp_path / "short.yaml"), str(path))
    found = make_rehearsal(order)
    own, rehearsed = order.config, found.config
    assert rehearsed.model_dump(include={"name", "limits", "thermometers", "dew", "ending", "target", "chamber"}) == (
        own.model_dump(include={"name", "limits", "thermometers", "dew", "ending", "target", "chamber"})
    )
    assert {name: axis.limits for name, axis in rehearsed.axes.items()} == {
        name: axis.limits for name, axis in own.axes.items()
    }
    assert rehearsed.camera is not None
    assert own.camera is not None
    assert (rehearsed.camera.exposure_s, rehearsed.camera.serial_number) == (
        own.camera.exposure_s,
        own.camera.serial_number,
    )
    assert rehearsed.bus.address.startswith("tcp:127.0.0.1")
    assert (rehearsed.alerts.command, rehearsed.compressor.state_file) == ((), None)
    assert make_rehearsal(found) == found


def test_an_axis_that_the_laboratory_does_not_have_is_reported(tmp_path: Path):
    data = yaml.safe_load(find_packaged("", "laboratory").read_text())
    axes = {"linear": data["axes"]["linear"], "tilt": data["axes"]["rotary"]}
    path = real_stand(tmp_path, axes=axes)
    with pytest.raises(ConfigError, match="tilt, only linear, rotary"):
        make_rehearsal(load_order(str(tmp_path / "short.yaml"), str(path)))
