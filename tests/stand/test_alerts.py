"""Alerts reach a local receiver; one that hangs, refuses or is not there delays nothing; secrets stay secret."""

import asyncio
import json
import os
import time
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from tests.addresses import move_to_free
from thermostand.foundation.clock import VirtualClock, WallClock
from thermostand.foundation.errors import ConfigError, DeviceError
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.alerts_section import AlertsConfig, load_secrets
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.running.order import load_order
from thermostand.stand.service.run import run_real
from thermostand.stand.serving import alerts as module
from thermostand.stand.serving.alerts import send_alerts
from thermostand.stand.serving.alerts_process import deliver, ping

from .alert_receiver import Receiver, until


@pytest.fixture
def receiver():
    receiver = Receiver()
    yield receiver
    receiver.close()


def publish(hub, clock, kind, level="warning", text="why", **data):
    hub.publish(Event(clock.now_ns(), level, kind, text, data))


async def reached(condition):
    await asyncio.to_thread(until, condition)


async def test_an_event_becomes_a_message_and_life_is_signalled(receiver, tmp_path: Path):
    config = AlertsConfig(secrets=receiver.secrets(tmp_path / "secrets.yaml"), alive_every_s=1)
    hub, clock = Hub(), WallClock()
    async with send_alerts("lab", config, hub, clock):
        publish(hub, clock, "guard.over_temperature", "error", "air is hot", rule="over_temperature", action="abort")
        await reached(lambda: receiver.messages)
        assert receiver.messages == [("lab: TRIPPED", "air is hot")]
        publish(hub, clock, "run.end", "error", "aborted", status="tripped")  # what is open is over with the run
        await reached(lambda: len(receiver.calls) >= 2)
        publish(hub, clock, "run.start", "info", "recipe demo")
    (title, text) = receiver.messages[-1]
    assert (title.partition(":")[0], text) == ("lab", "recipe demo")  # sent at the end at the latest
    assert set(receiver.calls) == {"/alive/TOKEN"}


async def test_no_sign_of_life_while_something_is_wrong_or_the_loop_stands_still(receiver, tmp_path: Path):
    config = AlertsConfig(secrets=receiver.secrets(tmp_path / "secrets.yaml"), alive_every_s=1)
    hub, clock, well = Hub(), WallClock(), [False]
    async with send_alerts("lab", config, hub, clock, lambda: well[0]):
        publish(hub, clock, "guard.x", "error", action="abort")
        await reached(lambda: receiver.messages)
        well[0] = True
        await asyncio.sleep(1.5)
        assert receiver.calls == []
        publish(hub, clock, "run.end", status="tripped")
        await reached(lambda: receiver.calls)


async def test_a_receiver_that_hangs_delays_nothing(receiver, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(module, "_FAREWELL_S", 0.5)
    config = AlertsConfig(secrets=receiver.secrets(tmp_path / "secrets.yaml"), alive_every_s=1)
    hub, clock = Hub(), WallClock()
    receiver.let_go.clear()
    longest_s = 0.0
    async with send_alerts("lab", config, hub, clock):
        await reached(lambda: receiver.calls)  # the sign of life hangs already
        for number in range(1000):
            before_s = time.monotonic()
            publish(hub, clock, "guard.x", "error", str(number), action="abort")
            longest_s = max(longest_s, time.monotonic() - before_s)
        ending_s = time.monotonic()
    assert longest_s < 1.0  # microseconds, and one is put in a queue while the others are sent
    assert time.monotonic() - ending_s < 20.0
    assert receiver.messages == []


async def test_what_a_receiver_refused_is_sent_again_and_reported_once_without_its_address(
    receiver, tmp_path: Path, monkeypatch
):
    monkeypatch.setattr(module, "_AGAIN_S", (0.1,) * 50)
    config = AlertsConfig(secrets=receiver.secrets(tmp_path / "secrets.yaml"))
    hub, clock, seen = Hub(), WallClock(), []
    receiver.status = 503
    async with send_alerts("lab", config, hub, clock):
        hub.subscribe(seen.append)
        publish(hub, clock, "prompt", text="close the door", attended=True)
        await reached(lambda: sum(item.kind == "alert_failed" for item in seen) == 2)
        receiver.status = 200
        await reached(lambda: receiver.messages)
    failures = [item.text for item in seen if item.kind == "alert_failed"]
    alive, delivery = sorted(failures)
    assert "alive_url failed (HTTPError)" in alive
    assert "receiver 1 of 1 (json)" in delivery


async def test_who_has_a_message_does_not_get_it_again_because_another_receiver_fails(
    receiver, tmp_path: Path, monkeypatch
):
    monkeypatch.setattr(module, "_AGAIN_S", (0.1,) * 3)
    tried: list[tuple[int, ...]] = []
    ask = module._Sender.ask

    def noted(self, call):
        tried.extend(call.args[4:])
        return ask(self, call)

    monkeypatch.setattr(module._Sender, "ask", noted)
    config = AlertsConfig(secrets=receiver.secrets(tmp_path / "secrets.yaml", "json://127.0.0.1:9/closed"))
    hub, clock = Hub(), WallClock()
    async with send_alerts("lab", config, hub, clock):
        publish(hub, clock, "prompt", text="close the door", attended=True)
        await reached(lambda: len(tried) == 4)
    assert tried == [(), (2,), (2,), (2,)]
    assert len(receiver.messages) == 1


async def test_a_run_that_fails_before_it_begins_is_reported(receiver, tmp_path: Path):
    config = AlertsConfig(secrets=receiver.secrets(tmp_path / "secrets.yaml"))
    with pytest.raises(ConfigError):
        async with send_alerts("lab", config, Hub(), WallClock()):
            raise ConfigError("no device")
    ((title, text),) = receiver.messages
    assert (title.partition(":")[0], text) == ("lab", "no device")


async def test_in_virtual_time_and_without_secrets_nothing_is_sent(receiver, tmp_path: Path):
    for config, clock in (
        (AlertsConfig(secrets=receiver.secrets(tmp_path / "s.yaml")), VirtualClock(0)),
        (AlertsConfig(), WallClock()),
    ):
        hub = Hub()
        async with send_alerts("lab", config, hub, clock):
            publish(hub, clock, "guard.x", "error", action="abort")
    assert receiver.messages == []


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_an_alert_is_text_also_for_a_receiver_of_html(receiver, tmp_path: Path):
    """As a mail is: a prompt, a name or a reason may be anybody's."""
    secrets = receiver.secrets(tmp_path / "s.yaml")
    secrets.write_text(secrets.read_text().replace("/TOKEN", "/TOKEN?format=html"))
    assert deliver(secrets, 60.0, "lab: <b>", "<script>alert(1)</script>") == []
    ((_, text),) = receiver.messages
    assert "<script" not in text
    assert "&lt;script" in text


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of a library that Apprise uses, sent from this process
def test_each_receiver_has_its_own_sentence(receiver, tmp_path: Path, caplog, capfd):
    closed = "json://127.0.0.1:9/TOKEN"
    secrets = receiver.secrets(tmp_path / "s.yaml", closed, "nonsense TOKEN", "noscheme://TOKEN")
    failures = deliver(secrets, 60.0, "title", "text")
    assert receiver.messages == [("title", "text")]
    assert [(number, text.partition(")")[0]) for number, text in failures] == [
        (2, "receiver 2 of 4 (json"),
        (3, "receiver 3 of 4 (no address"),
        (4, "receiver 4 of 4 (noscheme"),
    ]
    assert "TOKEN" not in caplog.text + "".join(capfd.readouterr())
    receiver.let_go.clear()
    assert "receiver 1 of 4 (json)" in deliver(secrets, 0.3, "title", "text")[0][1]
    assert ping(secrets, 0.3)[0][1].startswith("alive_url ")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o700 | 0o001])
def test_secrets_that_others_may_read_are_refused(tmp_path: Path, mode: int):
    path = tmp_path / "s.yaml"
    path.write_text("urls: [json://TOKEN]\n")
    path.chmod(mode)
    with pytest.raises(ConfigError, match=r"\(mode 0\d+\); type `chmod 600"):
        load_secrets(path)


@pytest.mark.parametrize("text", ["urls: TOKEN", "TOKEN: [", "alive_url: TOKEN", "\x00", "urls: [1]"])
def test_what_is_wrong_in_the_secrets_is_reported_without_them(tmp_path: Path, text: str):
    path = tmp_path / "s.yaml"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(ConfigError) as raised:
        load_secrets(path)
    assert "TOKEN" not in str(raised.value)
    assert raised.value.__cause__ is None


def test_a_folder_a_pipe_and_nothing_are_no_secrets(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe", 0o600)
    for place, reason in (
        (tmp_path, "is no file"),
        (tmp_path / "pipe", "is no file"),
        (tmp_path / "no", "cannot be read"),
    ):
        with pytest.raises(ConfigError, match=reason):
            load_secrets(place)


def config_with(tmp_path: Path, secrets: Path | None) -> Path:
    text = yaml.safe_dump(move_to_free(yaml.safe_load(find_packaged("", "simulated").read_text()), tmp_path))
    path = tmp_path / "stand.yaml"
    path.write_text(text + (f"alerts: {{secrets: {json.dumps(str(secrets))}}}\n" if secrets else ""))
    return path


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of a library that Apprise uses, sent from this process
def test_alert_test_tells_who_was_reached(receiver, tmp_path: Path):
    ask = CliRunner()
    path = config_with(tmp_path, receiver.secrets(tmp_path / "s.yaml"))
    result = ask.invoke(app, ["alert", "test", "--config", str(path)])
    assert (result.exit_code, result.stdout[:10]) == (0, "1 receiver")
    assert receiver.messages[0][0].endswith(": test")
    receiver.status = 500
    result = ask.invoke(app, ["alert", "test", "--config", str(path)])
    assert result.exit_code == 1
    assert "error: 2 of 2 were not reached" in result.stderr
    assert "TOKEN" not in result.output
    result = ask.invoke(app, ["alert", "test", "--config", str(config_with(tmp_path, None))])
    assert result.exit_code == 2
    assert "alerts.secrets" in result.stderr


async def test_a_run_whose_stand_does_not_answer_is_reported(receiver, tmp_path: Path):
    path = config_with(tmp_path, receiver.secrets(tmp_path / "s.yaml"))
    order = load_order("demo", str(path))
    with pytest.raises(DeviceError):
        await run_real(order, tmp_path / "sessions", lambda hub: None)
    ((title, text),) = receiver.messages
    assert "simulated-stand: " in title
    assert text.startswith("bus: ")
