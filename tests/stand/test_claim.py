"""A stand's addresses belong to one run of the machine, however they are written and wherever its locks lie."""

import asyncio
import hashlib
import json
import os
import re
import signal
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests import fork_server
from tests.addresses import move_to_free
from tests.sections import change
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import InUse, SessionError
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.opening import stand_lock
from thermostand.stand.running.opening.stand_lock import list_addresses, lock_stand
from thermostand.stand.serving import instances


def _simulated() -> str:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    return yaml.safe_dump(move_to_free(data, Path(f"/tmp/thermostand-{os.getpid()}")))


SIMULATED = _simulated()
"""Another run of this machine may have the addresses of the packaged one."""


def config(base: str = "simulated", **sections: dict[str, object]) -> StandConfig:
    data = yaml.safe_load(SIMULATED if base == "simulated" else find_packaged("", base).read_text())
    change(data, sections)
    return parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")


def bus(address: object) -> StandConfig:
    """A stand of which nothing but the bus has the same address as another."""
    return config("laboratory", bus={"address": str(address)}, **elsewhere(str(address)))


_others = iter(range(1, 250))


def elsewhere(seed: str) -> dict[str, Any]:
    number = next(_others)
    axis = {"profile": "8MT160-300", "limits": [0, 280]}
    axes = {"linear": {**axis, "address": f"serial:/dev/none{number}", "serial_number": number}}
    camera = {"address": f"192.0.2.{number}", "serial_number": f"C{number}"}
    return {"axes": axes, "flap": {"serial_number": f"F{number}"}, "camera": camera}


def without_rotary(found: StandConfig) -> StandConfig:
    return found.model_copy(update={"axes": {"linear": found.axes["linear"]}})


async def is_free(stand: StandConfig) -> bool:
    """Whether another run could have it now."""
    try:
        async with lock_stand(without_rotary(stand), Path("other")):
            return True
    except InUse:
        return False


@pytest.mark.parametrize(
    ("one", "other", "is_one_device"),
    [
        ("tcp:127.0.0.1:502", "tcp:127.0.0.1:502", True),
        ("tcp:127.0.0.1:502", "tcp:localhost:502", True),
        ("tcp:127.0.0.1:502", "tcp:0.0.0.0:502", True),
        ("tcp:127.0.0.1:502", "tcp:127.1:502", True),
        ("tcp:192.0.2.7:502", "tcp:192.0.2.7:0502", True),
        ("tcp:unknown.invalid:502", "tcp:UNKNOWN.invalid:502", True),
        ("tcp:192.0.2.7:502", "tcp:192.0.2.7:503", False),
        ("tcp:192.0.2.7:502", "tcp:192.0.2.8:502", False),
    ],
)
async def test_a_gateway_is_one_however_it_is_written(tmp_path: Path, one: str, other: str, is_one_device: bool):
    async with lock_stand(without_rotary(bus(one)), tmp_path):
        assert await is_free(bus(other)) is not is_one_device


async def test_a_serial_port_is_one_by_its_id_and_by_its_number(tmp_path: Path):
    port, by_id = tmp_path / "ttyUSB0", tmp_path / "usb-FTDI-port0"
    port.touch()
    by_id.symlink_to(port)
    async with lock_stand(without_rotary(bus(f"serial:{by_id}")), tmp_path):
        assert not await is_free(bus(f"serial:{port}"))
        assert not await is_free(bus(f"serial:{tmp_path}/../{tmp_path.name}/ttyUSB0"))
        assert await is_free(bus(f"serial:{tmp_path / 'ttyUSB1'}"))
        by_id.unlink()
        by_id.symlink_to(tmp_path / "ttyUSB1")  # plugged in again
        assert not await is_free(bus(f"serial:{by_id}"))


@pytest.mark.parametrize(("section", "name"), [("axes", "linear"), ("flap", "flap"), ("camera", "camera")])
async def test_any_device_in_use_keeps_the_whole_stand_from_being_touched(tmp_path: Path, section: str, name: str):
    mine, theirs = elsewhere(""), elsewhere("")
    mine[section] = theirs[section]
    theirs_ = config("laboratory", bus={"address": "tcp:192.0.2.1:502"}, **theirs)
    mine_ = config("laboratory", bus={"address": "tcp:192.0.2.2:502"}, **mine)
    async with lock_stand(without_rotary(theirs_), tmp_path / "cycle"):
        with pytest.raises(InUse) as refused:
            async with lock_stand(without_rotary(mine_), tmp_path / "other"):
                pass
        assert refused.value.device == name
        assert f"session {tmp_path / 'cycle'} (pid {os.getpid()}); nothing was touched" in str(refused.value)
        assert await is_free(bus("tcp:192.0.2.2:502"))  # what it had already is free again
    assert await is_free(mine_)


def test_simulated_laboratories_have_the_same_serial_numbers_and_are_not_the_same():
    places = {address.place for address in list_addresses(config())}
    assert not any("4101" in place or "00351210" in place or "TS-0001" in place for place in places)
    real = {address.place for address in list_addresses(config("laboratory"))}
    assert {"stage 4101", "stage 4102", "usb 00351210", "camera 12345678", "camera 192.168.10.2"} <= real


async def test_the_locks_say_who_has_them_to_their_user_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    async with lock_stand(config(), tmp_path / "cycle"):
        files = list((tmp_path / "thermostand").iterdir())
        answers = [json.loads(file.read_text()) for file in files]
    assert {stat.S_IMODE((tmp_path / "thermostand").stat().st_mode)} == {0o700}
    assert len(answers) >= 5
    assert all((each["session"], each["pid"]) == (str(tmp_path / "cycle"), os.getpid()) for each in answers)
    assert all(each["stand"] == "simulated-stand" for each in answers)
    bus = config().bus.address.removeprefix("tcp:")
    assert any(each["place"].startswith(f"tcp {bus}") for each in answers)
    assert list((tmp_path / "thermostand").iterdir()) == []


async def test_a_run_of_another_login_is_found_though_its_files_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "one"))
    async with lock_stand(config(), tmp_path):
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "other"))
        camera = re.escape(config().cameras["camera"].address)
        with pytest.raises(InUse, match=f"camera {camera} is in use by"):
            async with lock_stand(config(), tmp_path):
                pass


async def test_in_a_folder_of_its_group_nobody_else_takes_the_locks_of_a_real_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder, stand = tmp_path / "stands", without_rotary(bus("tcp:192.0.2.1:502"))
    place = next(address.place for address in list_addresses(stand) if address.device == "bus")
    monkeypatch.setattr(instances, "STANDS_FOLDER", folder)
    monkeypatch.setattr(stand_lock, "STANDS_FOLDER", folder)
    with socket.socket(socket.AF_UNIX) as anybody:
        anybody.bind(f"\0thermostand {hashlib.sha256(place.encode()).hexdigest()}")
        assert not await is_free(stand)
        folder.mkdir()
        folder.chmod(0o2770)
        async with lock_stand(stand, tmp_path / "cycle"):
            assert {stat.S_IMODE(file.stat().st_mode) for file in folder.iterdir()} == {0o660}
            with pytest.raises(InUse, match=f"in use by session {tmp_path / 'cycle'}"):
                async with lock_stand(stand, tmp_path / "other"):
                    pass
    assert list(folder.iterdir()) == []
    folder.chmod(0o2777)
    with pytest.raises(SessionError, match="root has made"):
        async with lock_stand(stand, tmp_path / "cycle"):
            pass


async def test_a_runtime_folder_that_cannot_be_used_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "thermostand").touch()
    with pytest.raises(SessionError, match="set XDG_RUNTIME_DIR"):
        async with lock_stand(config(), tmp_path):
            pass


HOLDER = """
import asyncio, sys
from pathlib import Path
from thermostand.stand.config.stand_config import load_config
from thermostand.stand.running.opening.stand_lock import lock_stand

async def run():
    async with lock_stand(load_config(Path(sys.argv[1])), Path("/their/cycle")):
        print("has it", flush=True)
        await asyncio.Event().wait()

try:
    asyncio.run(run())
except Exception as error:
    print(error, flush=True)
"""


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[], "subprocess.Popen[str]"]]:
    file = tmp_path / "stand.yaml"
    file.write_text(SIMULATED)
    started: list[subprocess.Popen[str]] = []

    def begin() -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "tests.code", HOLDER, file]
        started.append(fork_server.popen(command, stdout=subprocess.PIPE, text=True))
        return started[-1]

    yield begin
    for process in started:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


async def test_of_several_that_begin_at_once_one_gets_it_and_its_death_gives_it_free(
    tmp_path: Path, start: Callable[[], "subprocess.Popen[str]"]
):
    processes = [start() for _ in range(3)]
    answers = {process.pid: process.stdout.readline() for process in processes if process.stdout is not None}
    (holder,) = [process for process in processes if answers.pop(process.pid) == "has it\n"]
    assert all(f"session /their/cycle (pid {holder.pid})" in line for line in answers.values())
    holder.send_signal(signal.SIGSTOP)
    assert not await is_free(config())
    holder.kill()
    await asyncio.to_thread(holder.wait)
    assert await is_free(config())
