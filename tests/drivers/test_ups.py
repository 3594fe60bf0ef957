"""A UPS by its upsd: over the wire of the simulated one, with every answer that a real one gives, and a real upsd."""

import asyncio
import math
import os
import socket
import subprocess
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from tests.addresses import find_free_port
from thermostand.drivers.devices.device_check import DeviceCheck, Finding
from thermostand.drivers.devices.ups import KIND, Ups, UpsSettings
from thermostand.drivers.sim.units.ups import FakeUps, UpsdEngine
from thermostand.drivers.sim.wire import LinkFaults, TcpWire
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.readings import Quality, Reading

# The programs themselves: Debian puts scripts before them that ask its own configuration.
UPSD, DUMMY = Path("/lib/nut/upsd"), Path("/lib/nut/dummy-ups")


class Bench:
    """A UPS on its wire and its driver."""

    def __init__(self, **settings: object) -> None:
        self.fake = FakeUps("rack", {"thermostand": "pass-word"})
        self.faults = LinkFaults(seed=2)
        self.wire = TcpWire("127.0.0.1", 0, lambda: UpsdEngine(self.fake), self.faults)
        self.driver = make_driver(self.wire.address, **settings)

    async def read(self) -> dict[str, Reading]:
        return await read(self.driver)


def make_driver(address: str, **settings: object) -> Ups:
    given = {"kind": "ups", "address": address, "timeout_s": 0.2, **settings}
    return Ups("ups", UpsSettings.model_validate(given), WallClock())


async def read(driver: Ups) -> dict[str, Reading]:
    return {each.channel.partition(".")[2]: each for each in await driver.read()}


def values(found: dict[str, Reading]) -> list[float]:
    return [each.value for each in found.values()]


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    found = Bench()
    yield found
    await found.driver.close()
    found.wire.close()


async def test_it_reports_which_ups_it_is_what_is_left_and_whether_mains_is_on(bench: Bench):
    await bench.driver.open()
    found = await bench.read()
    assert [(name, each.unit) for name, each in found.items()] == [
        ("charge", "%"),
        ("runtime", "s"),
        ("on_battery", "1"),
        ("low_battery", "1"),
    ]
    assert values(found) == [100.0, 1800.0, 0.0, 0.0]
    assert str(bench.driver.identity) == 'Simulated "UPS" S 1500, serial number U-1'
    bench.fake.mains_failed = True
    bench.fake.advance(0, 900.0)
    assert values(await bench.read()) == [50.0, 900.0, 1.0, 0.0]
    bench.fake.advance(0, 600.0)
    assert [each.reason for each in (await bench.read()).values()] == ["", "", "OB DISCHRG LB", "OB DISCHRG LB"]


async def test_the_check_names_a_silent_one_and_what_its_status_says(bench: Bench):
    def look() -> list[tuple[str, str, str]]:
        return [(each.what, each.verdict, each.text) for each in found]

    found: list[Finding] = []
    made = {
        "device": bench.driver, "settings": UpsSettings(kind="ups", address=bench.wire.address), "section": "devices",
        "advise": lambda error: "advice", "clock": WallClock(), "modbus": None, "is_bus_up": True, "made": {},
        "opened": set[str](), "of_section": lambda name: None, "map_of": lambda name, unit: None, "add": found.append,
    }  # fmt: skip
    check = DeviceCheck(**made)
    await KIND.check(check)
    assert look()[-1] == ("reading", "ok", "charge 100 %, runtime 1800 s, on_battery 0, low_battery 0")
    found.clear()
    bench.fake.status = "OL RB"
    await KIND.check(check)
    assert look()[-1] == ("state", "warning", "low_battery: OL RB")
    found.clear()
    bench.fake.driver_gone = True
    await KIND.check(check)
    assert look() == [("reading", "failed", "its driver is not connected to upsd")]


@pytest.mark.parametrize(
    ("status", "on_battery", "low_battery"),
    [
        ("OL", 0, 0),
        ("OL CHRG", 0, 0),
        ("OB", 1, 0),
        ("OB LB", 1, 1),
        ("ALARM OB DISCHRG", 1, 0),
        ("FSD OL", 0, 1),
        ("BYPASS", 0, 0),
        ("", None, None),
        ("WAIT", None, None),
        ("OBLIGED", None, None),
    ],
)
async def test_each_status_is_read_by_its_whole_words(
    bench: Bench, status: str, on_battery: float | None, low_battery: float | None
):
    bench.fake.status = status
    await bench.driver.open()
    found = await bench.read()
    expected = [math.nan if each is None else each for each in (on_battery, low_battery)]
    assert [found["on_battery"].value, found["low_battery"].value] == pytest.approx(expected, nan_ok=True)
    assert found["charge"].value == 100.0


@pytest.mark.parametrize("fault", ["stale", "driver_gone"])
async def test_an_upsd_that_knows_nothing_now_is_silent_and_its_next_answer_counts(bench: Bench, fault: str):
    await bench.driver.open()
    setattr(bench.fake, fault, True)
    found = await bench.read()
    assert {(each.quality, each.cause) for each in found.values()} == {(Quality.BAD, "wire")}
    setattr(bench.fake, fault, False)
    assert values(await bench.read()) == [100.0, 1800.0, 0.0, 0.0]


@pytest.mark.parametrize("change", ["silent", "cut", "drop", "junk", "closed"])
async def test_a_wire_that_fails_gives_bad_readings_and_heals(bench: Bench, change: str):
    await bench.driver.open()
    if change == "closed":
        bench.wire.unplug()
    else:
        setattr(bench.faults, change, True if change == "silent" else 1.0)
    found = await bench.read()
    assert {(each.quality, each.cause) for each in found.values()} == {(Quality.BAD, "wire")}
    if change == "closed":
        return
    setattr(bench.faults, change, False if change == "silent" else 0.0)
    assert values(await bench.read()) == [100.0, 1800.0, 0.0, 0.0]


@pytest.mark.parametrize("change", ["byte_by_byte", "hangs_up"])
async def test_replies_in_pieces_and_connections_that_end_are_read(bench: Bench, change: str):
    setattr(bench.faults, change, True)
    await bench.driver.open()
    assert values(await bench.read()) == [100.0, 1800.0, 0.0, 0.0]


async def test_a_stand_opens_without_it_and_reads_it_once_it_answers():
    driver = make_driver("tcp:127.0.0.1:9")
    await driver.open()
    assert {each.quality for each in await driver.read()} == {Quality.BAD}
    await driver.close()
    assert {each.quality for each in await driver.read()} == {Quality.BAD}


async def test_what_the_ups_does_not_tell_is_bad_and_the_rest_is_read(bench: Bench):
    bench.fake.untold = {"battery.runtime", "device.serial", "device.mfr", "device.model"}
    await bench.driver.open()
    found = await bench.read()
    assert (found["runtime"].quality, found["runtime"].cause) == (Quality.BAD, "device")
    assert [found[name].value for name in ("charge", "on_battery", "low_battery")] == [100.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "answers",
    [
        b'VAR rack ups.status "OL\n',  # not closed
        b"VAR rack ups.status OL\n",
        b'VAR other ups.status "OB"\n',
        b'VAR rack ups.status "OB"',  # no end of the line
        b'VAR rack ups.status "OL"\nVAR rack ups.status "OB"\n',
        b"\xff\xfe\n",
        b"ERR\n",
        b"ERR \n",
        b"\n",
    ],
)
async def test_a_reply_that_is_none_is_never_a_status(answers: bytes):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection:
                    while connection.recv(4096):
                        connection.sendall(answers)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        driver = make_driver(f"tcp:127.0.0.1:{server.getsockname()[1]}", ups="rack", timeout_s=0.05)
        await driver.open()
        assert {each.quality for each in await driver.read()} == {Quality.BAD}
        await driver.close()
        server.shutdown(socket.SHUT_RDWR)
    thread.join(2.0)


async def test_it_is_found_by_its_name_among_several_and_another_name_is_refused(bench: Bench):
    driver = make_driver(bench.wire.address, ups="other")
    await driver.open()
    readings = await driver.read()
    assert {(each.quality, each.cause) for each in readings} == {(Quality.BAD, "device")}
    assert "UNKNOWN-UPS" in readings[0].reason
    await driver.close()


async def test_with_a_user_it_logs_in_once_for_each_connection(tmp_path: Path):
    secrets = tmp_path / "ups.yaml"
    secrets.write_text("user: thermostand\npassword: pass-word\n")
    secrets.chmod(0o600)
    bench = Bench(secrets=secrets)
    await bench.driver.open()
    assert values(await bench.read()) == [100.0, 1800.0, 0.0, 0.0]
    assert bench.fake.logins == 1
    bench.fake.users["thermostand"] = "another"
    await bench.driver.close()
    await bench.driver.open()
    found = await bench.read()
    assert {each.quality for each in found.values()} == {Quality.BAD}
    assert "ACCESS-DENIED" in found["charge"].reason
    assert "pass-word" not in found["charge"].reason
    await bench.driver.close()
    secrets.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        await bench.driver.open()
    bench.wire.close()


@pytest.fixture
def upsd(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """Where the real upsd of Network UPS Tools answers, for a UPS that its dummy driver makes of a file."""
    if not (UPSD.exists() and DUMMY.exists()) or os.getuid() != 0:
        pytest.skip("the package nut-server is not installed, or the tests are not run by root")
    port, state = find_free_port(), tmp_path / "lab.dev"
    state.write_text("ups.status: OL CHRG\nbattery.charge: 87\nbattery.runtime: 1234\n")
    files = {
        "ups.conf": f"maxretry = 1\n[lab]\ndriver = dummy-ups\nport = {state}\nmode = dummy-once\n",
        "upsd.conf": f"LISTEN 127.0.0.1 {port}\nMAXAGE 15\n",
        "upsd.users": "[stand]\npassword = secret-word\nupsmon secondary\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o640)
    tmp_path.chmod(0o700)
    around = {
        **os.environ,
        "NUT_CONFPATH": str(tmp_path),
        "NUT_STATEPATH": str(tmp_path),
        "NUT_ALTPIDPATH": str(tmp_path),
    }
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": around}
    driver = subprocess.Popen([DUMMY, "-a", "lab", "-u", "root", "-D"], **quiet)
    server = subprocess.Popen([UPSD, "-u", "root", "-D"], **quiet)
    try:
        yield f"tcp:127.0.0.1:{port}", state
    finally:
        for process in (server, driver):
            process.terminate()
            process.wait(10)


async def test_the_upsd_of_network_ups_tools_is_understood(upsd: tuple[str, Path], tmp_path: Path):
    address, state = upsd
    secrets = tmp_path / "secrets.yaml"
    secrets.write_text("user: stand\npassword: secret-word\n")
    secrets.chmod(0o600)
    driver = make_driver(address, secrets=secrets, timeout_s=1.0)
    await driver.open()
    assert await poll_until(driver, "charge", 87.0)
    found = await read(driver)
    assert values(found) == [87.0, 1234.0, 0.0, 0.0]
    assert str(driver.identity) == "Dummy Manufacturer Dummy UPS"
    state.write_text("ups.status: OB DISCHRG LB\nbattery.charge: 12\nbattery.runtime: 90\n")
    assert await poll_until(driver, "on_battery", 1.0)
    found = await read(driver)
    assert values(found) == [12.0, 90.0, 1.0, 1.0]
    await driver.close()


async def poll_until(driver: Ups, channel: str, value: float) -> bool:
    """Whether it reads so within 20 s."""
    for _ in range(200):
        if (await read(driver))[channel].value == value:
            return True
        await asyncio.sleep(0.1)
    return False
