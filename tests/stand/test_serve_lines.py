"""What `stand serve` says of what happens, for people and for programs."""

import json
import math
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.output import Output, set_output
from thermostand.stand.commands import serve_cli
from thermostand.stand.commands.command_table import app
from thermostand.stand.commands.serve_cli import _show_events

LOST = Event(7, "warning", "device_lost", "linear does not answer", {"device": "linear", "lost_s": math.nan})


def shown(wanted: Output) -> None:
    hub = Hub()
    with set_output(wanted), _show_events(hub):
        hub.publish(Event(6, "info", "home_residual", "of no importance"))
        hub.publish(LOST)


def test_people_read_what_to_type(capsys: pytest.CaptureFixture[str]):
    shown(Output())
    assert capsys.readouterr() == ("", "linear does not answer; `stand devices` shows what is connected\n")


def test_programs_get_events_one_a_line(capsys: pytest.CaptureFixture[str]):
    shown(Output(verbose=True, as_json=True))
    out, err = capsys.readouterr()
    first, second = map(json.loads, out.splitlines())
    assert (first["kind"], err) == ("home_residual", "")
    assert second == {
        "time_ns": 7,
        "level": "warning",
        "kind": "device_lost",
        "text": "linear does not answer",
        "data": {"device": "linear", "lost_s": None},
    }


def test_a_port_in_use_is_reported_before_any_device_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    opened: list[object] = []
    monkeypatch.setattr(serve_cli, "serve_stand", lambda *args, **_: opened.append(args))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        refused = CliRunner().invoke(app, ["serve", "simulated", "--out", str(tmp_path), "--port", str(port)])
    assert refused.exit_code == 2
    assert f"--port {port}: cannot listen at 127.0.0.1 (Address already in use)" in refused.stderr
    assert not opened
