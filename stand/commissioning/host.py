"""The computer a stand is run from: whether its disk keeps up with the cameras, and whether its clock is right."""

from __future__ import annotations

import ctypes
import os
import shutil
import tempfile
import time

from thermostand.drivers.devices.checking import Finding
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.run_estimate import existing

_PIECES, _PIECE_BYTES = 8, 4_000_000
_SLOWEST_FLUSH_S = 1.0
_MARGIN = 2.0  # how much faster than the cameras a disk has to be
_FRAME_BYTES = 2448 * 2048  # of a camera whose size is not in the stand's file
_LEAST_MB_s = 10.0

_UNSYNCHRONISED = 5  # adjtimex(2): TIME_ERROR
_TIMEX_BYTES = 208
_ESTIMATE_AT, _MAXIMUM_AT = 32, 24  # of esterror and maxerror in struct timex, longs of us on 64-bit Linux


def disk(config: StandConfig) -> Finding:
    """Write and flush beside the sessions, as a night does; blocking, up to some seconds."""
    folder = existing(config.recording.directory)
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
    needed_MB_s = max(_LEAST_MB_s, _MARGIN * _frames_MB_s(config))
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


def _frames_MB_s(config: StandConfig) -> float:
    sizes = (
        (camera.width_px * camera.height_px if camera.width_px and camera.height_px else _FRAME_BYTES)
        * camera.frame_rate_hz
        for camera in config.cameras.values()
    )
    return sum(sizes) / 1e6


def clock() -> Finding:
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


def findings(config: StandConfig) -> tuple[Finding, ...]:
    """Disk and clock; blocking."""
    return disk(config), clock()
