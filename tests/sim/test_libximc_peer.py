"""The vendor's own library drives the fake stages, over a pseudo-terminal and over TCP.

The fakes run in a process of their own: a library call that blocks must not stand still what it waits for.
"""

import importlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

LABORATORY = """
import sys
from pathlib import Path
from thermostand.foundation.clock import WallClock
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.drivers.sim.motion.ximc import FakeAxis
from thermostand.drivers.sim.motion.ximc_table import LINEAR_8MT160_300, ROTARY_8MR151

clock = WallClock()
plant = Plant(PlantSpec(), clock.now_ns())
linear = FakeAxis(plant, clock, LINEAR_8MT160_300, 0x1234, "linear", start_steps=200)
rotary = FakeAxis(plant, clock, ROTARY_8MR151, 0x5678, "rotary", start_steps=1300)
pty = PtyWire(Path(sys.argv[1]), linear.engine(), LinkFaults())
tcp = TcpWire("127.0.0.1", 0, rotary.engine, LinkFaults())
print(tcp.port, flush=True)
sys.stdin.read()
pty.close()
"""

MOVE, MOVR, HOME = 1, 2, 6
IS_HOMED, EEPROM_CONNECTED = 0x20, 0x10


@pytest.fixture(scope="module")
def ximc() -> ModuleType:
    try:
        return importlib.import_module("libximc.highlevel")
    except (ImportError, OSError) as error:
        if os.environ.get("CI") == "true" and platform.machine() == "x86_64" and sys.platform == "linux":
            pytest.fail(f"libximc is part of the test set-up: {error}")
        pytest.skip(f"libximc does not load here: {error}")


@pytest.fixture(scope="module")
def addresses(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    port_path = tmp_path_factory.mktemp("ports") / "linear"
    root = Path(__file__).resolve().parents[2]
    with subprocess.Popen(
        [sys.executable, "-c", LABORATORY, str(port_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=root,
    ) as process:
        assert process.stdout is not None
        tcp_port = process.stdout.readline().strip()
        yield {"linear": f"xi-com://{port_path}", "rotary": f"xi-tcp://127.0.0.1:{tcp_port}"}
        process.communicate()
    assert process.returncode == 0


@pytest.fixture(params=["linear", "rotary"])
def stage(request: pytest.FixtureRequest, addresses: dict[str, str]) -> str:
    return request.param


@pytest.fixture
def axis(ximc: ModuleType, addresses: dict[str, str], stage: str) -> Iterator[Any]:
    axis = ximc.Axis(addresses[stage])
    axis.open_device()
    yield axis
    axis.close_device()


def hurry(axis: Any) -> None:
    """A few thousand steps per second, so that the test does not wait for the stage."""
    move = axis.get_move_settings()
    move.Speed, move.Accel, move.Decel = 5_000, 20_000, 20_000
    axis.set_move_settings(move)
    home = axis.get_home_settings()
    home.FastHome = 3_000
    axis.set_home_settings(home)


def test_it_reads_who_the_controller_is(axis: Any, stage: str) -> None:
    information = axis.get_device_information()
    assert (information.Manufacturer, information.ProductDescription) == ("XIMC", "XISM-USB")
    assert axis.get_serial_number() == {"linear": 0x1234, "rotary": 0x5678}[stage]
    assert tuple(axis.get_firmware_version()) == (4, 7, 6)
    assert axis.get_stage_name().PositionerName == {"linear": "8MT160-300", "rotary": "8MR151-30"}[stage]


def test_it_reads_the_profile_the_stage_was_delivered_with(axis: Any, stage: str) -> None:
    engine, edges, power = axis.get_engine_settings(), axis.get_edges_settings(), axis.get_power_settings()
    secure, home = axis.get_secure_settings(), axis.get_home_settings()
    linear = stage == "linear"
    assert (engine.NomCurrent, engine.NomSpeed, engine.Antiplay) == (
        (1_200, 3_200, 575) if linear else (670, 5_000, 1_800)
    )
    assert (engine.MicrostepMode, engine.StepsPerRev) == (9, 200)
    assert (edges.LeftBorder, edges.RightBorder) == ((2_500, 116_500) if linear else (-33_850, 350))
    assert (edges.BorderFlags.value, edges.EnderFlags.value) == ((6, 7) if linear else (0, 0))
    assert (power.HoldCurrent, power.PowerOffDelay, power.PowerFlags.value) == (50, 60, 7 if linear else 5)
    assert (secure.CriticalUpwr, secure.MinimumUusb, secure.Flags.value) == (5_500, 420, 0x9D)
    assert (home.HomeDelta, home.HomeFlags.value) == (500 if linear else -1_250, 0x172)
    assert axis.get_ctp_settings().CTPFlags.value == 0x10
    assert axis.get_feedback_settings().FeedbackType.value == (5 if linear else 4)
    assert axis.get_entype_settings().EngineType.value == 3


def test_it_homes_and_moves_the_stage(axis: Any) -> None:
    hurry(axis)
    axis.command_homezero()
    status = axis.get_status()
    assert status.MvCmdSts.value == HOME
    assert status.Flags.value == EEPROM_CONNECTED | IS_HOMED
    assert (status.CurPosition, status.uCurPosition) == (0, 0)
    axis.command_move(400, -100)
    axis.command_wait_for_stop(10)
    status = axis.get_status()
    assert (status.MvCmdSts.value, status.CurPosition * 256 + status.uCurPosition) == (MOVE, 400 * 256 - 100)
    axis.command_movr(100, 50)
    axis.command_wait_for_stop(10)
    status = axis.get_status()
    assert (status.MvCmdSts.value, status.CurPosition * 256 + status.uCurPosition) == (MOVR, 500 * 256 - 50)
    axis.command_stop()
    axis.command_zero()
    position = axis.get_position()
    assert (position.Position, position.uPosition) == (0, 0)


def test_it_learns_of_a_corrected_value(axis: Any) -> None:
    move = axis.get_move_settings()
    move.Accel = 0
    with pytest.raises(ValueError, match="rejected"):
        axis.set_move_settings(move)
    assert axis.get_move_settings().Accel == 1
    assert axis.get_status().Flags.value & 0x4
    axis.command_stop()
    assert not axis.get_status().Flags.value & 0x4
