"""The order in which a stand is looked at: the computer, then device by device; with moves each moves when it answers.

The stand's addresses are locked as for a run, before anything is opened. Without moves no actuator is ever commanded;
with them everything that moved is made safe at the end, and closed.
"""

from __future__ import annotations

import asyncio
import ctypes
import importlib.metadata
import json
import os
import platform
import shutil
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache, partial
from itertools import groupby
from pathlib import Path
from typing import cast

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from thermostand.drivers.devices.cameras.cameras_by_protocol import check_settings
from thermostand.drivers.devices.device_check import Add, DeviceCheck, Finding, Verdict, check_identity, find_worst
from thermostand.drivers.devices.kinds import Equipment
from thermostand.drivers.devices.protocols import Actuator, Camera
from thermostand.drivers.settings import Identity
from thermostand.foundation.clock import NS_PER_S, Clock
from thermostand.foundation.errors import DeviceError, InUse, StandError, StandTripped, Superseded, Unreachable
from thermostand.foundation.events import DEAD_MAN_TESTED, HOME_RESIDUAL, HOME_RESIDUAL_LARGE
from thermostand.foundation.files import write_atomically
from thermostand.foundation.items import Event, Item
from thermostand.foundation.readings import Quality
from thermostand.stand.assembly.assemble import Assembly, load_unit_map
from thermostand.stand.config.check_record import compute_digest, get_record_files
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.run_estimate import find_existing
from thermostand.stand.running.opening.open_stand import make_safe, open_bench
from thermostand.stand.running.opening.stop import Stop

# The commissioning record: what `stand check` found, as JSON and HTML next to the stand's file.

SCHEMA = "stand-check/1"


@dataclass(frozen=True, slots=True)
class CommissioningRecord:
    """One check. texts: the stand's file and its register maps, by the names under which sessions have them."""

    config: StandConfig
    file: str
    texts: Mapping[str, str]
    began_ns: int
    ended_ns: int
    has_moves: bool
    findings: Sequence[Finding]
    identities: Mapping[str, Identity]

    def data(self) -> dict[str, object]:
        """The whole record; instants are UTC."""
        return {
            "schema": SCHEMA,
            "stand": self.config.name,
            "config": self.file,
            "digests": {name: compute_digest(text) for name, text in self.texts.items()},
            "began": _format_utc(self.began_ns),
            "ended": _format_utc(self.ended_ns),
            "moves": self.has_moves,
            "simulated": self.config.simulation is not None,
            "operator": self.config.operator,
            "host": platform.node(),
            "software_version": importlib.metadata.version("thermostand"),
            "verdict": find_worst(self.findings),
            "identities": {name: asdict(identity) for name, identity in self.identities.items()},
            "lenses": {name: camera.lens for name, camera in self.config.cameras.items() if camera.lens},
            "findings": [asdict(finding) for finding in self.findings],
        }

    def html(self) -> str:
        """The same, to be read and printed."""
        counts: dict[Verdict, int] = {"failed": 0, "warning": 0, "unverified": 0, "ok": 0}
        for finding in self.findings:
            counts[finding.verdict] += 1
        groups = [(name, tuple(found)) for name, found in groupby(self.findings, lambda finding: finding.device)]
        return _load_template().render(
            record=self,
            counts=counts,
            groups=[(name, find_worst(found), found) for name, found in groups],
            began=_format_utc(self.began_ns).replace("T", " ").removesuffix("+00:00"),
            took_s=(self.ended_ns - self.began_ns) / NS_PER_S,
            host=platform.node(),
            version=importlib.metadata.version("thermostand"),
            digests={name: compute_digest(text)[:16] for name, text in self.texts.items()},
        )

    def write(self, config: Path) -> tuple[Path, Path]:
        """Replace the record next to the stand's file `config`; return its files. SessionError when refused."""
        data, page = get_record_files(config)
        write_atomically(page, self.html())
        write_atomically(data, json.dumps(self.data(), indent=2, ensure_ascii=False) + "\n")
        return data, page


def _format_utc(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // NS_PER_S, UTC).isoformat()


@cache
def _load_template() -> Template:
    loader = PackageLoader("stand", "commissioning")
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return made.get_template("record.html.jinja")


# What only shows when something moves: the timer that guards the heat, the flap, the stages, the cameras' frames.
#
# All of it goes through the verbs of the stand, so through its gate and interlock. Nothing is heated: the heater's
# relay is held for some seconds while the permissions are withdrawn and the regulator is stopped with an output of 0.

_FRAMES = 6  # enough for a rate; round number, nothing was measured
_SLOW = 0.8  # of the longest travel that the stand's file allows
_MOST_APART_K = 10.0  # a chamber so far from its laboratory keeps its flap shut


class MovementChecks:
    """Movement checks of the devices that answer, by their names in `opened`; each says what it found."""

    def __init__(self, assembly: Assembly, opened: set[str], add: Add) -> None:
        self._assembly = assembly
        self._opened = opened
        self._add = add
        self._events: list[Event] = []
        assembly.hub.subscribe(self._follow)

    async def of(self, each: Equipment) -> None:
        """Check what moves of this device; from now on it is made safe at the end."""
        device = self._assembly.devices.every[each.name]
        if each.name in self._opened and hasattr(device, "make_safe"):
            self._assembly.stand.opened(cast("Actuator", device))
        if each.kind.device == "regulator":
            await self.check_heat_timer()
        elif device is self._assembly.devices.flap:
            await self.check_flap()
        elif each.name in self._assembly.devices.axes:
            await self.check_axis(each.name)

    async def check_heat_timer(self) -> None:
        """Does the board drop the heater's relay in time, and does a timed-on sent again start its time again?"""
        stand, devices = self._assembly.stand, self._assembly.devices
        name, what = devices.relays.name, "timed-on"
        if not {name, devices.regulator.name} <= self._opened:
            text = "not measured, since relay board and regulator do not both answer"
            self._add(Finding(name, what, "unverified", text, "mend them, and check again"))
            return
        try:
            await stand.chamber.permits.switch_off_left_on()
            await devices.regulator.stop()
            await stand.chamber.test_dead_man(is_timed=True)
        except StandTripped:
            raise
        except StandError as error:
            text = error.text if isinstance(error, DeviceError) else str(error)
            to_do = "nothing may be heated with it: take a board with a timer that re-arms, and look at the wiring"
            self._add(Finding(name, what, "failed", text, to_do, self._find_last_event(DEAD_MAN_TESTED)))
            return
        data = self._find_last_event(DEAD_MAN_TESTED)
        if not devices.relays.has_timer:
            self._add(Finding(name, what, "ok", "no relay board, so none to be measured"))
            return
        text = f"a timed-on of {data.get('pulse_s')} s that was sent again held for {data.get('held_s')} s from then"
        self._add(Finding(name, what, "ok", text, data=data))

    async def check_flap(self) -> None:
        """Open and close, each with its time."""
        name, flap = self._assembly.devices.flap.name, self._assembly.config.flap
        if flap is None or name not in self._opened:
            return
        if apart_K := await self._measure_offset_K():
            text = f"not moved: the chamber is {apart_K:+.0f} K from the laboratory"
            self._add(
                Finding(name, "travel", "unverified", text, "check again when it is at the laboratory's temperature")
            )
            return
        imaging, clock, travel_s = self._assembly.stand.imaging, self._assembly.clock, flap.travel_s
        try:
            await imaging.close_flap()
            open_s = await _measure_duration_s(imaging.open_flap(), clock)
            close_s = await _measure_duration_s(imaging.close_flap(), clock)
        except Superseded:
            raise
        except DeviceError as error:
            self._add(Finding(name, "travel", "failed", error.text, self._advice(error, name)))
            return
        data: dict[str, object] = {"open_s": open_s, "close_s": close_s, "travel_s": travel_s}
        text = f"opens in {open_s:.1f} s, closes in {close_s:.1f} s"
        if max(open_s, close_s) > _SLOW * travel_s:
            to_do = f"nearly flap.travel_s ({travel_s:g} s): raise that, or look what holds it"
            self._add(Finding(name, "travel", "warning", text, to_do, data))
            return
        self._add(Finding(name, "travel", "ok", text, data=data))

    async def check_axis(self, name: str) -> None:
        """Home; one that had a home before reports how far it was off, and goes back to where it was."""
        if name not in self._opened:
            return
        stand, axis = self._assembly.stand, self._assembly.devices.axes[name]
        try:
            position, *_ = await axis.read()
            was_homed = await axis.homed()
            took_s = await _measure_duration_s(stand.table.check_home(name), self._assembly.clock)
            low, high = self._assembly.config.axes[name].limits
            if was_homed and low <= position.value <= high:
                await stand.table.move_to(name, position.value)
        except Superseded:
            raise
        except DeviceError as error:
            self._add(Finding(name, "home", "failed", error.text, self._advice(error, name)))
            return
        if not was_homed:
            text = f"homed in {took_s:.1f} s; it had no home before, so there is nothing to compare"
            self._add(Finding(name, "home", "ok", text, data={"took_s": took_s}))
            return
        data = {**self._find_last_event(HOME_RESIDUAL, HOME_RESIDUAL_LARGE), "took_s": took_s}
        text = f"its home was off by {data['residual']} {data['unit']} ({data['steps']} steps)"
        if any(event.kind == HOME_RESIDUAL_LARGE and event.data.get("axis") == name for event in self._events):
            to_do = "it has lost steps, or its switch moves: look at load, speed and switch, and check again"
            self._add(Finding(name, "home", "warning", text, to_do, data))
            return
        self._add(Finding(name, "home", "ok", text, data=data))

    async def cameras(self) -> None:
        """Frames as fast as they come, and the temperature behind them; a supply that was off is off again at the
        end, also when an operator breaks the check off: it is then made safe with what moved."""
        stand = self._assembly.stand
        if not self._assembly.devices.cameras or self._assembly.devices.relays.name not in self._opened:
            return  # there are none, or that their relay does not answer was reported
        try:
            await self._check_supplied_cameras()
        finally:
            if stand.imaging.supply.was_on is False:
                stand.safety.take(stand.imaging.supply)

    async def _check_supplied_cameras(self) -> None:
        devices, supply = self._assembly.devices, self._assembly.stand.imaging.supply
        try:
            await supply.switch_on()
        except Superseded:
            raise
        except DeviceError as error:
            name = error.device if error.device in devices.cameras else next(iter(devices.cameras))
            to_do = self._advice(error, name)
            self._add(Finding(name, "link", "failed", error.text, to_do))
            return
        for name, camera in devices.cameras.items():
            if name not in self._opened:
                self._opened.add(name)
                self._add(check_identity(camera))
                await check_settings(camera, self._add)
            await self._check_frames(name, camera)
        if supply.was_on is False:
            await supply.switch_off()

    async def _check_frames(self, name: str, camera: Camera) -> None:
        wanted_hz = camera.settings.frame_rate_hz
        try:
            first = await camera.grab()  # starts the acquisition
            begin_ns = self._assembly.clock.now_ns()
            frames = [await camera.grab() for _ in range(_FRAMES)]
            took_s = (self._assembly.clock.now_ns() - begin_ns) / NS_PER_S
            temperature, *_ = await camera.read()
        except DeviceError as error:
            self._add(Finding(name, "frames", "failed", error.text, self._advice(error, name)))
            return
        rate_hz, dropped = _FRAMES / took_s, sum(frame.dropped for frame in frames)
        megabytes = first.image.nbytes / 1e6
        data: dict[str, object] = {
            "rate_hz": round(rate_hz, 2),
            "MB_s": round(rate_hz * megabytes, 1),
            "dropped": dropped,
            "mean_grey": round(float(first.image.mean()), 1),
        }
        text = f"{rate_hz:.1f} frames per s, {rate_hz * megabytes:.0f} MB/s, {dropped} lost"
        if dropped or rate_hz < wanted_hz:
            to_do = f"{wanted_hz:g} per s are asked for: jumbo frames (MTU 9000, packet_size 8000)? a packet_delay_ns?"
            self._add(Finding(name, "frames", "warning", text, to_do, data))
        else:
            self._add(Finding(name, "frames", "ok", text, data=data))
        if temperature.quality is Quality.GOOD:
            found: dict[str, object] = {"camera_degC": temperature.value}
            self._add(Finding(name, "temperature", "ok", f"{temperature.value:.1f} degC", data=found))
        elif camera.settings.has_temperature:
            to_do = "say where it is in cameras.NAME.temperature, or has_temperature: false"
            self._add(Finding(name, "temperature", "failed", temperature.reason, to_do))

    async def _measure_offset_K(self) -> float:
        """Return how far the chamber's air is from the laboratory; 0 when it is near, or not known."""
        devices = self._assembly.devices
        if devices.thermometers.name not in self._opened:
            return 0.0
        try:
            readings = {each.channel.partition(".")[2]: each for each in await devices.thermometers.read()}
        except DeviceError:
            return 0.0
        air, outside = readings.get("air"), readings.get("laboratory", readings.get("granite_outside"))
        if air is None or outside is None or {air.quality, outside.quality} != {Quality.GOOD}:
            return 0.0
        apart_K = air.value - outside.value
        return apart_K if abs(apart_K) > _MOST_APART_K else 0.0

    def _advice(self, error: DeviceError, name: str) -> str:
        each = next(each for each in self._assembly.equipment if each.name == name)
        return each.kind.advise(error, name, each.settings)

    def _follow(self, item: Item) -> None:
        if isinstance(item, Event):
            self._events.append(item)

    def _find_last_event(self, *kinds: str) -> dict[str, object]:
        """The data of the last such event."""
        return next((dict(event.data) for event in reversed(self._events) if event.kind in kinds), {})


async def _measure_duration_s(work: Awaitable[object], clock: Clock) -> float:
    begin_ns = clock.now_ns()
    await work
    return round((clock.now_ns() - begin_ns) / NS_PER_S, 2)


COMMAND = "stand check"

Tell = Callable[[tuple[Finding, ...]], None]


async def commission(
    config: StandConfig, tell: Tell, *, has_moves: bool
) -> tuple[tuple[Finding, ...], dict[str, Identity]]:
    """Everything that was found, reported group by group as it is found, and which devices have answered.

    InUse when the stand belongs to another program: then nothing was touched. Interrupted when it was stopped, and
    ConfigError.
    """
    found: list[Finding] = []
    async with AsyncExitStack() as stack:
        stop = await stack.enter_async_context(Stop())
        assembly = await stack.enter_async_context(open_bench(config, COMMAND))
        if has_moves:
            stack.push_async_callback(_make_safe, assembly, stop, found, tell)
            stop.watch(assembly.stand)
        reported = 0
        async for _ in _check_devices(assembly, found.append, has_moves=has_moves):
            tell(tuple(found[reported:]))
            reported = len(found)
        return tuple(found), _collect_identities(assembly)


async def _check_devices(assembly: Assembly, add: Add, *, has_moves: bool) -> AsyncIterator[None]:
    """Yields after each device."""
    for finding in await asyncio.to_thread(_check_computer, assembly.config):
        add(finding)
    yield
    opened: set[str] = set()
    moves = MovementChecks(assembly, opened, add) if has_moves else None
    is_bus_up = await _is_bus_up(assembly, add)
    yield
    for each in assembly.equipment:
        name, kind, settings = each
        device = assembly.devices.every[name]
        await kind.check(
            DeviceCheck(
                device=device,
                settings=settings,
                section=kind.section,
                advise=partial(_advise, each),
                clock=assembly.clock,
                modbus=assembly.bus,
                is_bus_up=is_bus_up,
                made=assembly.devices.every,
                opened=opened,
                of_section=partial(getattr, assembly.config),
                map_of=load_unit_map,
                add=add,
                is_powered_later=has_moves,
            )
        )
        if moves is not None:
            await moves.of(each)
        yield
    if moves is not None:
        await moves.cameras()
        yield


def _advise(each: Equipment, error: DeviceError) -> str:
    return each.kind.advise(error, each.name, each.settings)


async def _is_bus_up(assembly: Assembly, add: Add) -> bool:
    """The line that the units share."""
    try:
        await assembly.bus.open()
    except DeviceError as error:
        if isinstance(error, InUse):
            advice = "end the other program"
        elif assembly.config.simulation is not None:
            advice = "this stand is simulated: start its laboratory with `stand simulate FILE` in another terminal"
        else:
            advice = "is the adapter plugged in, its address right, and no other program using it? `stand devices`"
            advice += " lists the ports"
        add(Finding("bus", "link", "failed", error.text, advice))
        return False
    add(Finding("bus", "link", "ok", f"{assembly.bus.address} is open"))
    return True


async def _make_safe(assembly: Assembly, stop: Stop, found: list[Finding], tell: Tell) -> None:
    """Everything that may have moved; a failure when it is not confirmed."""
    if unsafe := await make_safe(assembly, stop):
        text = f"NOT SAFE: {'; '.join(unsafe)}"
        found.append(Finding("stand", "made safe", "failed", text, "look at the stand now"))
        tell((found[-1],))


def _collect_identities(assembly: Assembly) -> dict[str, Identity]:
    """Collect the identities of the devices that have answered."""
    known: dict[str, Identity] = {}
    for name, device in assembly.devices.every.items():
        with suppress(Unreachable):  # a camera that is not open
            if device.identity is not None:
                known[name] = device.identity
    return known


# The computer a stand is run from: whether its disk keeps up with the cameras, and whether its clock is right.
_PIECES, _PIECE_BYTES = 8, 4_000_000
_SLOWEST_FLUSH_S = 1.0  # a commit is due each second
_MARGIN = 2.0  # how much faster than the cameras a disk has to be
_FRAME_BYTES = 2448 * 2048  # of a camera whose size is not in the stand's file
_LEAST_MB_s = 10.0  # round number; not measured

_UNSYNCHRONISED = 5  # adjtimex(2): TIME_ERROR
_TIMEX_BYTES = 208
_ESTIMATE_AT, _MAXIMUM_AT = 32, 24  # of esterror and maxerror in struct timex, longs of us on 64-bit Linux


def _check_disk(config: StandConfig) -> Finding:
    """Write and flush in the folder of the sessions, as a run does; this blocks for up to some seconds."""
    folder = find_existing(config.recording.directory)
    piece, slowest_s, begin_s = os.urandom(_PIECE_BYTES), 0.0, time.perf_counter()
    try:
        with tempfile.TemporaryFile(dir=folder, prefix=".check-") as file:
            for _ in range(_PIECES):
                flush_s = time.perf_counter()
                file.write(piece)
                file.flush()
                os.fsync(file.fileno())
                slowest_s = max(slowest_s, time.perf_counter() - flush_s)
        free_GB = shutil.disk_usage(folder).free / 1e9
    except OSError as error:
        text = f"nothing can be written to {folder} ({error.strerror})"
        return Finding("disk", "speed", "failed", text, "give recording.directory a folder that this user may write to")
    speed_MB_s = _PIECES * _PIECE_BYTES / 1e6 / (time.perf_counter() - begin_s)
    needed_MB_s = max(_LEAST_MB_s, _MARGIN * _compute_frames_MB_s(config))
    data: dict[str, object] = {
        "folder": str(folder),
        "speed_MB_s": round(speed_MB_s, 1),
        "needed_MB_s": round(needed_MB_s, 1),
        "slowest_flush_s": round(slowest_s, 3),
        "free_GB": round(free_GB, 1),
    }
    text = f"{speed_MB_s:.0f} MB/s, slowest flush {slowest_s:.2f} s, {free_GB:.0f} GB free in {folder}"
    if speed_MB_s < needed_MB_s:
        advice = f"the cameras may need {needed_MB_s:.0f} MB/s; take another disk, or frame_encoding: roi"
        return Finding("disk", "speed", "warning", text, advice, data)
    if slowest_s > _SLOWEST_FLUSH_S:
        return Finding("disk", "speed", "warning", text, "is something else writing to it, or is it failing?", data)
    return Finding("disk", "speed", "ok", text, data=data)


def _compute_frames_MB_s(config: StandConfig) -> float:
    sizes = (
        (camera.width_px * camera.height_px if camera.width_px and camera.height_px else _FRAME_BYTES)
        * camera.frame_rate_hz
        for camera in config.cameras.values()
    )
    return sum(sizes) / 1e6


def _check_clock() -> Finding:
    """Return whether the kernel's clock follows a time server (adjtimex)."""
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)
    try:
        state = ctypes.CDLL(None).adjtimex(timex)
    except (OSError, AttributeError):
        state = -1
    if state < 0:
        text = "it is not known whether the clock follows a time server"
        return Finding("clock", "sync", "unverified", text, "compare it with another clock")
    longs = (int.from_bytes(timex.raw[at : at + 8], "little", signed=True) for at in (_ESTIMATE_AT, _MAXIMUM_AT))
    estimate_s, maximum_s = (value / 1e6 for value in longs)
    data: dict[str, object] = {"synchronised": state != _UNSYNCHRONISED, "error_s": estimate_s, "at_most_s": maximum_s}
    if state == _UNSYNCHRONISED:
        text = "the clock follows no time server, so times of sessions may be wrong"
        return Finding("clock", "sync", "warning", text, "install and start chrony, or systemd-timesyncd", data)
    return Finding("clock", "sync", "ok", f"follows a time server, within {maximum_s:.2g} s", data=data)


def _check_computer(config: StandConfig) -> tuple[Finding, ...]:
    """Disk and clock; blocking."""
    return _check_disk(config), _check_clock()
