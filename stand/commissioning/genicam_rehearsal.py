"""A camera that is only a GenICam file yet: what of it a stand would use, found by opening it in the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivers.devices.cameras.camera_gige import Camera
from drivers.devices.cameras.camera_gige import Settings as GigeSettings
from foundation.clock import WallClock
from foundation.errors import DeviceError
from stand.config.simulation import SimulatedCamera
from stand.config.stand_config import StandConfig, load_config, packaged
from stand.simulator import Simulator, laboratory_of

_NAME = "camera"


_ANY = GigeSettings(address="127.0.0.1", exposure_s=0.01)  # some make no longer one without another setting


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What came of it. camera: vendor and model by the file. features: {"exposure": "ExposureTimeAbs", ...}, what would
    be used for each purpose, "" for nothing. refusal: why it cannot be used, "" when it opened and gave a frame."""

    camera: str
    features: dict[str, str]
    refusal: str


async def rehearse(file: Path, stand: StandConfig | None = None) -> Rehearsal:
    """Dress a simulated camera in the file, set it as the stand's first GigE camera (else as usual) and grab a frame.
    ConfigError when the file is no GenICam file."""
    settings = _settings_of(stand)
    simulated = load_config(packaged("", "simulated"))
    if simulated.simulation is None:
        raise ValueError("the installed simulated stand has no simulation")
    simulation = simulated.simulation.model_copy(update={"cameras": {_NAME: SimulatedCamera(genicam=file)}})
    simulated = simulated.model_copy(update={"cameras": {_NAME: settings}, "simulation": simulation})
    laboratory = laboratory_of(simulated, virtual=False, seed=None, is_anywhere=True)
    # nobody switches it on: without a relay board it has power
    simulator = Simulator({**laboratory, "relays_unit": None, "relay_channels": {}, "camera_boot_s": 0.0})
    try:
        return await _opened(settings.model_copy(update={"address": simulator.addresses[_NAME]}))
    finally:
        simulator.stop()


def _settings_of(stand: StandConfig | None) -> GigeSettings:
    """Of the stand's first GigE camera, whatever its serial number; when there is none, such as each camera can."""
    cameras = () if stand is None else stand.cameras.values()
    first = next((each for each in cameras if isinstance(each, GigeSettings)), _ANY)
    return first.model_copy(update={"serial_number": None})


async def _opened(settings: GigeSettings) -> Rehearsal:
    camera = Camera(_NAME, settings, WallClock())
    who = ""
    try:
        await camera.open()
        who = f"{camera.identity.vendor} {camera.identity.model}"
        place = await camera.temperature_place() or "none"
        frame = await camera.grab()
        took = camera.effective
        size = f"{frame.image.shape[1]} x {frame.image.shape[0]} px, {took.pixel_format}, packets of {took.packet_size}"
        return Rehearsal(who, {**took.features, "temperature": place, "frame": size}, "")
    except DeviceError as error:
        return Rehearsal(who, {}, str(error))
    finally:
        await camera.close()
