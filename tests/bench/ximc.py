"""Stage status over a pseudo-terminal beside the vendor's library on the same fake.

Both ask for GETS and get 48 bytes; `Axis.read` is the same through the stage driver, its lane and its readings. Each
side has a serial wire of its own to one fake axis, because both open theirs exclusively.
"""

from __future__ import annotations

import asyncio
import importlib
import time
from pathlib import Path
from typing import Protocol

from tests.bench.fakes import fakes
from tests.bench.figures import Figure, in_turns, per_second, progress, side_by_side, skipped
from thermostand.drivers.devices.motion.stage import Axis, AxisSettings
from thermostand.drivers.wires.link import SerialSettings, open_link
from thermostand.drivers.wires.ximc_client import XimcClient
from thermostand.foundation.clock import WallClock

ROUNDS = 9
READS = 400  # in one measurement
STATUS_SIZE = 48
PEER = "libximc get_status()"


class VendorAxis(Protocol):
    """As much of the untyped peer as is used."""

    def get_status(self) -> object:
        """GETS, decoded."""
        ...


def figures(directory: Path) -> list[Figure]:
    """Status reads per second of the client, and of the driver above it."""
    try:
        highlevel = importlib.import_module("libximc.highlevel")
    except (ImportError, OSError) as error:
        return [skipped("XIMC status", f"libximc: {error}")]
    ours, other = directory / "ximc-ours", directory / "ximc-other"
    with fakes("ximc", ours, other):
        peer = highlevel.Axis(f"xi-com://{other}")
        peer.open_device()
        try:
            progress("XIMC status, client and driver")
            return [_client(ours, peer), _driver(ours, peer)]
        finally:
            peer.close_device()


def _client(path: Path, peer: VendorAxis) -> Figure:
    settings = SerialSettings(baud=115200, stopbits=2)
    client = XimcClient("linear", lambda: open_link("linear", f"serial:{path}", settings))
    own, other = in_turns(
        lambda: per_second(lambda: client.query("gets", STATUS_SIZE), READS),
        lambda: per_second(peer.get_status, READS),
        ROUNDS,
    )
    client.close()
    return side_by_side("XIMC pty, ximc_client status", "reads/s", PEER, own, other)


def _driver(path: Path, peer: VendorAxis) -> Figure:
    axis = Axis(
        "linear",
        AxisSettings(address=f"serial:{path}", serial_number=0x1234, profile="8MT160-300", limits=(0, 280)),
        WallClock(),
    )
    with asyncio.Runner() as runner:
        runner.run(axis.open())
        own, other = in_turns(
            lambda: runner.run(_reads_per_second(axis)), lambda: per_second(peer.get_status, READS), ROUNDS
        )
        runner.run(axis.close())
    return side_by_side("XIMC pty, Axis.read()", "reads/s", PEER, own, other)


async def _reads_per_second(axis: Axis) -> float:
    begin_s = time.perf_counter()
    for _ in range(READS):
        await axis.read()
    return READS / (time.perf_counter() - begin_s)
