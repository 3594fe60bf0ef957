"""The order in which a stand is looked at: the computer, then device by device; with moves each moves when it answers.

The stand's addresses are locked as for a run, before anything is opened. Without moves no actuator is ever commanded;
with them everything that moved is made safe at the end, and closed.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import shutil
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, suppress
from functools import partial

from thermostand.drivers.devices.device_check import Add, DeviceCheck, Finding
from thermostand.drivers.devices.kinds import Equipment
from thermostand.drivers.settings import Identity
from thermostand.foundation.errors import DeviceError, InUse, Unreachable
from thermostand.stand.assembly.assemble import Assembly, load_unit_map
from thermostand.stand.commissioning.moves import MovementChecks
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.run_estimate import find_existing
from thermostand.stand.running.opening.open_stand import make_safe, open_bench
from thermostand.stand.running.opening.stop import Stop

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
_LEAST_MB_s = 10.0

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
    """Whether the kernel's clock follows a time server (adjtimex)."""
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
