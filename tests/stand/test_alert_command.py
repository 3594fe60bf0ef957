"""A program of one's own is a receiver of the alerts: what it gets, and what comes of one that fails or hangs."""

import asyncio
import os
import select
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.addresses import move_to_free
from tests.stand.alert_receiver import Receiver, until
from thermostand.foundation.clock import VirtualClock, WallClock
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import CONFIRMED_SAFE, NOT_CONFIRMED_SAFE, QUEUE_EMPTY, RUN_START
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.alerts_section import AlertsConfig
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.serving import alerts as module
from thermostand.stand.serving.alerts import check_alerts, send_alerts
from thermostand.stand.serving.alerts_process import run_command


@pytest.fixture
def script(tmp_path: Path) -> Callable[[str], str]:
    """An executable shell script; what it is given is "$@"."""

    def make(body: str) -> str:
        path = tmp_path / "tell"
        path.write_text(f"#!/bin/sh\n{body}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return str(path)

    return make


def trip(hub: Hub, clock: WallClock, text: str = "it is so") -> None:
    hub.publish(Event(clock.now_ns(), "error", "guard.rule0", text, {"rule": "rule0", "action": "abort"}))


async def comes(condition: Callable[[], bool]) -> None:
    await asyncio.to_thread(until, condition)


async def test_a_command_gets_a_trip_as_one_argument(tmp_path: Path, script: Callable[[str], str]):
    reported = tmp_path / "reported"
    config = AlertsConfig(command=(script(f'printf "%s|" "$@" > {reported}'), "--to", "a b"))
    hub, clock = Hub(), WallClock()
    async with send_alerts("lab", config, hub, clock):
        trip(hub, clock)
    *options, text, end = reported.read_text().split("|")
    assert (options, end) == (["--to", "a b"], "")
    assert text.startswith("lab: TRIPPED: ")


async def test_what_is_not_safe_is_reported_and_that_it_is_safe_again(tmp_path: Path, script: Callable[[str], str]):
    reported = tmp_path / "reported"
    config = AlertsConfig(command=(script(f'echo "$1" >> {reported}'),))
    hub, clock = Hub(), WallClock()
    async with send_alerts("lab", config, hub, clock):
        trip(hub, clock)
        hub.publish(NOT_CONFIRMED_SAFE.at(clock.now_ns(), "relays: no answer", unconfirmed=["relays: no answer"]))
        hub.publish(CONFIRMED_SAFE.at(clock.now_ns()))
    lines = reported.read_text().splitlines()
    assert [line.split(": ")[1] for line in lines] == ["TRIPPED", "TRIPPED", "ok again"]
    assert "relays: no answer" in lines[1]


async def test_a_command_gets_its_causes_only(tmp_path: Path, script: Callable[[str], str]):
    reported = tmp_path / "reported"
    config = AlertsConfig(command=(script(f'echo "$1" >> {reported}'),), command_causes=("queue_empty",))
    hub, clock = Hub(), WallClock()
    async with send_alerts("lab", config, hub, clock):
        trip(hub, clock)
        hub.publish(RUN_START.at(clock.now_ns(), recipe="demo"))
        hub.publish(QUEUE_EMPTY.at(clock.now_ns()))
    (line,) = reported.read_text().splitlines()
    assert line.startswith("lab: the queue")


async def test_a_command_that_hangs_is_killed_and_an_event(
    script: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(module, "_FAREWELL_S", 0.1)
    config = AlertsConfig(command=(script("exec sleep 600"),), command_limit_s=0.2)
    hub, clock, seen = Hub(), WallClock(), list[Item]()
    async with send_alerts("lab", config, hub, clock):
        hub.subscribe(seen.append)
        trip(hub, clock)
        await comes(lambda: len(seen) == 2)
    kinds = [(event.kind, event.text) for event in seen if isinstance(event, Event)]
    assert [kind for kind, _ in kinds[:2]] == ["guard.rule0", "alert_failed"]
    assert kinds[1][1].endswith("did not end within 0.2 s")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
async def test_a_command_that_hangs_delays_no_address(tmp_path: Path, script: Callable[[str], str]):
    """The command ends only when the other receiver has the message."""
    has_it, receiver = tmp_path / "has-it", Receiver()
    command = script(f"until [ -e {has_it} ]; do sleep 0.05; done")
    config = AlertsConfig(command=(command,), command_limit_s=60, secrets=receiver.secrets(tmp_path / "s.yaml"))
    hub, clock = Hub(), WallClock()
    try:
        async with send_alerts("lab", config, hub, clock):
            trip(hub, clock)
            await comes(lambda: bool(receiver.messages))
            has_it.touch()
    finally:
        receiver.close()
    assert receiver.messages == [("lab: TRIPPED", "it is so")]


@pytest.mark.parametrize("command", ["/nowhere/tell", "no-such-program-here", "/dev/null"])
def test_a_command_that_cannot_be_run_is_refused(command: str):
    with pytest.raises(ConfigError, match=f"alerts.command: {command} is no program"):
        check_alerts(AlertsConfig(command=(command,)))


async def test_in_virtual_time_no_command_is_run(tmp_path: Path, script: Callable[[str], str]):
    reported, hub = tmp_path / "reported", Hub()
    async with send_alerts("lab", AlertsConfig(command=(script(f"touch {reported}"),)), hub, VirtualClock(0)):
        trip(hub, WallClock())
    assert not reported.exists()


def test_alert_test_runs_the_command(tmp_path: Path, script: Callable[[str], str]):
    import yaml

    data = move_to_free(yaml.safe_load(find_packaged("", "simulated").read_text()), tmp_path)
    for body, status in (("true", 0), ("exit 7", 1)):
        path = tmp_path / "stand.yaml"
        path.write_text(yaml.safe_dump(data | {"alerts": {"command": [script(body)]}}))
        assert CliRunner().invoke(app, ["alert", "test", "--config", str(path)]).exit_code == status


def test_a_command_that_fails_does_not_exist_or_hangs_gives_a_sentence(tmp_path: Path, script: Callable[[str], str]):
    ((number, failure),) = run_command((str(tmp_path / "none"),), 5.0, "title", "text")
    assert number == 1
    assert "could not be started (" in failure
    assert run_command((script("true"),), 5.0, "title", "text") == []
    assert run_command((script("exit 7"),), 5.0, "title", "text")[0][1].endswith("ended with status 7")
    os.mkfifo(pipe := tmp_path / "pipe")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        hanging = script(f"sleep 600 > {pipe} & wait")
        assert run_command((hanging,), 0.3, "title", "text")[0][1].endswith("did not end within 0.3 s")
        assert select.select([reader], [], [], 10.0)[0]  # nobody has the other end open: its child is gone, too
        assert os.read(reader, 1) == b""
    finally:
        os.close(reader)
