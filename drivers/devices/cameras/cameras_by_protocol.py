"""The camera protocols: each is one file `camera_<protocol>.py` next to this one, with `Settings` and `Camera`.

`Settings` is a subclass of CameraSettings with `protocol: Literal["<protocol>"] = "<protocol>"`, and `Camera(name,
settings, clock)` is a protocols.Camera.
"""

from __future__ import annotations

import importlib
import pkgutil
import socket
from collections.abc import Iterator, Mapping
from dataclasses import asdict, is_dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Protocol, Union, cast

from pydantic import Discriminator, Tag

import thermostand.drivers.devices.cameras
from thermostand.drivers.devices.cameras.shared_line import add_line_share, compute_line_shares
from thermostand.drivers.devices.device_check import Add, DeviceCheck, Finding
from thermostand.drivers.devices.kinds import Absence, DeviceKind, DriverContext, LockedPlace, Verb, VerbNumber
from thermostand.drivers.devices.protocols import Camera
from thermostand.drivers.devices.relays import CAMERA_POWER
from thermostand.drivers.settings import CameraSettings
from thermostand.foundation.clock import Clock
from thermostand.foundation.document_faults import TAG
from thermostand.foundation.errors import DeviceError, Unreachable
from thermostand.foundation.readings import Channel

LONGEST_EXPOSURE_S = 10.0  # as in recipes (experiments/parameters.py)
_IP_MTU = 14  # linux/in.h
_GVCP = 3956
_ADVICE = "give it a lower frame_rate_hz, larger packets (packet_size, with jumbo frames), or a line of its own"
_PREFIX, _USUAL = "camera_", "gige"


class _Driver(Protocol):
    Settings: type[CameraSettings]

    def Camera(self, name: str, settings: Any, clock: Clock) -> Camera: ...


def _load_drivers() -> dict[str, _Driver]:
    names = sorted(module.name for module in pkgutil.iter_modules(thermostand.drivers.devices.cameras.__path__))
    return {
        name.removeprefix(_PREFIX): cast(
            "_Driver", importlib.import_module(f"thermostand.drivers.devices.cameras.{name}")
        )
        for name in names
        if name.startswith(_PREFIX)
    }


PROTOCOLS = _load_drivers()


def _get_protocol(value: object) -> object:
    if isinstance(value, dict):
        return f"{TAG}{cast('dict[str, object]', value).get('protocol', _USUAL)}"
    return f"{TAG}{getattr(value, 'protocol', None)}"


if TYPE_CHECKING:
    AnyCameraSettings = CameraSettings
elif len(PROTOCOLS) == 1:
    AnyCameraSettings = PROTOCOLS[_USUAL].Settings
else:
    _tagged = tuple(Annotated[driver.Settings, Tag(f"{TAG}{name}")] for name, driver in PROTOCOLS.items())
    _of_protocol = Discriminator(
        _get_protocol,
        custom_error_type="camera_protocol",
        custom_error_message=f"protocol has to be one of {', '.join(PROTOCOLS)}",
    )
    AnyCameraSettings = Annotated[Union[_tagged], _of_protocol]  # noqa: UP007 - of a tuple


def _make(name: str, settings: CameraSettings, around: DriverContext) -> Camera:
    """The camera of these settings, not opened."""
    driver = next(driver for driver in PROTOCOLS.values() if type(settings) is driver.Settings)
    return driver.Camera(name, add_line_share(settings, around.of_section("cameras").values()), around.clock)


def _list_places(settings: CameraSettings) -> Iterator[LockedPlace]:
    yield LockedPlace("host", settings.address)
    if settings.serial_number is not None:
        yield LockedPlace("number", f"camera {settings.serial_number}")


def _advise(error: DeviceError, name: str, settings: CameraSettings) -> str:
    if isinstance(error, Unreachable):
        return f"is it plugged in, and its address right? `stand devices --ask {settings.address}` asks there"
    return f"compare cameras.{name} in the stand's file with the camera"


def check_packets(name: str, address: str, packet_size: int) -> Finding:
    """Return whether the network interface towards the camera takes its packets whole: larger ones are lost, or come in
    pieces that the camera does not send again."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as towards:
        try:
            towards.connect((address, _GVCP))
            mtu = towards.getsockopt(socket.IPPROTO_IP, _IP_MTU)
        except OSError as error:
            text = f"packets of {packet_size} bytes; the line's own limit is not known ({error.strerror})"
            return Finding(name, "packets", "unverified", text, "look at the MTU of its network interface")
    data: dict[str, object] = {"packet_size": packet_size, "mtu": mtu}
    text = f"packets of {packet_size} bytes, the network interface takes up to {mtu}"
    if packet_size > mtu:
        to_do = f"`ip link set INTERFACE mtu 9000`, on a switch, too; or packet_size: {min(mtu, 1500)}"
        return Finding(name, "packets", "failed", text, to_do, data)
    return Finding(name, "packets", "ok", text, data=data)


async def _check(look: DeviceCheck) -> None:
    """Check its settings, its temperature and its line; one without supply is left alone."""
    await _check_powered(look)
    for finding in check_line(look.of_section("cameras"), look.name):
        look.add(finding)


def check_line(cameras: Mapping[str, CameraSettings], name: str) -> Iterator[Finding]:
    """Return what the camera of that name needs of its line, by the stand's file; none for one that has a line of its
    own."""
    for line in compute_line_shares(cameras):
        if line.name == name and line.shared_by > 1:
            fits = line.frame_s <= 1 / cameras[name].frame_rate_hz
            text = str(line).removeprefix(f"{name}: ")
            yield Finding(name, "line", "ok" if fits else "failed", text, "" if fits else _ADVICE, asdict(line))


async def _check_powered(look: DeviceCheck) -> None:
    if not await _is_supplied(look):
        if not look.is_powered_later:
            text = "its supply is off, so it was not asked"
            look.found("link", "unverified", text, "`stand check --moves` switches it on")
        return
    if "relays" not in look.opened:
        look = replace(look, advise=_mend_relays)
    await look.open_and_read()
    if look.name in look.opened:
        await check_settings(look.device, look.add)


def _mend_relays(_: DeviceError) -> str:
    return "mend the relays first: its supply may be off"


async def check_settings(camera: Camera, add: Add) -> None:
    """Check what the camera made of its settings, and where it shows its temperature."""
    effective = cast("Any", getattr(camera, "effective", None))
    data: dict[str, object] = asdict(cast("Any", effective)) if is_dataclass(effective) else {}
    size = f"{data['width_px']} x {data['height_px']} {data['pixel_format']}, " if "width_px" in data else ""
    data["temperature_place"] = await camera.describe_temperature_place()
    add(Finding(camera.name, "settings", "ok", f"{size}settings taken over and read back", data=data))
    packet_size = data.get("packet_size")
    if isinstance(packet_size, int) and packet_size:  # a USB3 camera has none
        add(check_packets(camera.name, camera.settings.address, packet_size))


async def _is_supplied(look: DeviceCheck) -> bool:
    """Return whether the camera is powered, as far as the relays show."""
    if "relays" not in look.opened:
        return True
    try:
        readings = await look.made["relays"].read()
    except DeviceError:
        return True
    return all(reading.value == 1 for reading in readings if reading.channel == f"relays.{CAMERA_POWER}")


KIND = DeviceKind(
    name="camera",
    settings=CameraSettings,
    make=_make,
    channels=(Channel("temperature", "degC", "temperature"),),
    section="cameras",
    rank=90,
    is_opened=False,  # when it has its supply
    places=_list_places,
    missing=Absence("cameras", "a recipe that takes frames is refused"),
    advise=_advise,
    check=_check,
    verbs=(
        Verb("on", "switch the supply of all cameras on", lambda stand, name, given: stand.supply_cameras(is_on=True)),
        Verb(
            "off", "switch the supply of all cameras off", lambda stand, name, given: stand.supply_cameras(is_on=False)
        ),
        Verb(
            "frame",
            "take one frame",
            lambda stand, _, given: stand.take_frame(given["exposure_s"]),
            lambda camera, _: (VerbNumber("exposure_s", "s", 0.0, LONGEST_EXPOSURE_S, camera.exposure_s),),
        ),
    ),
)
