"""A camera that is only a GenICam file yet: what of it a stand would use, found by opening it in the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.devices.cameras.camera_gige import Settings as GigeSettings
from thermostand.drivers.wires import genicam_feature_names as words
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import DeviceError, Unreachable
from thermostand.stand.assembly.simulator import ControlSocket, Simulator, describe_laboratory
from thermostand.stand.config.simulation import SimulatedCamera
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config

_NAME = "camera"
_SET_BY = (*words.EXPOSURE, *words.EXPOSURE_STEP_US, *words.NECESSARY, "TriggerSoftware")

_ANY = GigeSettings(address="127.0.0.1", exposure_s=0.01)  # some make no longer one without another setting


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What came of it. camera: vendor and model by the file. features: {"exposure": "ExposureTimeAbs", ...}, what would
    be used for each purpose, "" for nothing. refusal: why it cannot be used, "" when it opened and gave a frame.
    unplayed: features that no value of their registers makes work here; is_played: False when the refusal is the
    rehearsal's own, and says nothing of the camera."""

    camera: str
    features: dict[str, str]
    refusal: str
    unplayed: tuple[str, ...] = ()
    is_played: bool = True


async def rehearse(file: Path, stand: StandConfig | None = None) -> Rehearsal:
    """Dress a simulated camera in the file, set it as the stand's first GigE camera (else as usual) and grab a frame.
    ConfigError when the file is no GenICam file."""
    settings = _get_settings(stand)
    simulated = load_config(find_packaged("", "simulated"))
    if simulated.simulation is None:
        raise ValueError("the installed simulated stand has no simulation")
    simulation = simulated.simulation.model_copy(update={"cameras": {_NAME: SimulatedCamera(genicam=file)}})
    simulated = simulated.model_copy(update={"cameras": {_NAME: settings}, "simulation": simulation})
    laboratory = describe_laboratory(simulated, virtual=False, seed=None, is_anywhere=True)
    # nobody switches it on: without a relay board it has power
    devices = {
        name: each for name, each in cast("dict[str, object]", laboratory["devices"]).items() if name != "relays"
    }
    simulator = Simulator({**laboratory, "devices": devices, "camera_boot_s": 0.0})
    try:
        unplayed = await _list_unsupported_features(simulator)
        return await _try_camera(settings.model_copy(update={"address": simulator.addresses[_NAME]}), unplayed)
    finally:
        simulator.stop()


def _get_settings(stand: StandConfig | None) -> GigeSettings:
    """Get the settings of the stand's first GigE camera, whatever its serial number; when there is none, such as each
    camera can."""
    cameras = () if stand is None else stand.cameras.values()
    first = next((each for each in cameras if isinstance(each, GigeSettings)), _ANY)
    return first.model_copy(update={"serial_number": None})


async def _list_unsupported_features(simulator: Simulator) -> tuple[str, ...]:
    """The features that the simulated camera cannot play, of those that a camera is set by."""
    control = ControlSocket(simulator.addresses["control"])
    await control.open()
    try:
        answer = await control.request({"do": "unplayed"})
    finally:
        await control.close()
    return tuple(map(str, cast("list[object]", answer[_NAME])))


def _explain_unsupported(error: DeviceError, unplayed: tuple[str, ...]) -> str:
    """Return why what went wrong is the rehearsal's own, "" when it is the file's. A simulated camera that is
    understood always gives frames, and takes what its registers can hold."""
    missed = [name for name in unplayed if name in _SET_BY]
    if not missed and not isinstance(error, Unreachable):
        return ""
    why = f"no value of its registers makes {', '.join(missed)} work" if missed else "it is brought to no frame by it"
    return f"the rehearsal cannot play this file: {why}; that says nothing of the camera itself ({error.text})"


async def _try_camera(settings: GigeSettings, unplayed: tuple[str, ...]) -> Rehearsal:
    camera = AravisCamera(_NAME, settings, WallClock())
    who = ""
    try:
        await camera.open()
        who = f"{camera.identity.vendor} {camera.identity.model}"
        place = await camera.describe_temperature_place() or "none"
        frame = await camera.grab()
        took = camera.effective
        size = f"{frame.image.shape[1]} x {frame.image.shape[0]} px, {took.pixel_format}, packets of {took.packet_size}"
        return Rehearsal(who, {**took.features, "temperature": place, "frame": size}, "", unplayed)
    except DeviceError as error:
        own = _explain_unsupported(error, unplayed)
        return Rehearsal(who, {}, own or str(error), unplayed, is_played=not own)
    finally:
        await camera.close()
