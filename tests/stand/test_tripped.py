"""Whether the stand has tripped: every surface answers alike, whatever happened to what is on the disk."""

from __future__ import annotations

import asyncio
import json
import shutil
import threading
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from tests.addresses import find_free_port, move_to_free
from tests.stand.secop_talk import talking
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import StandTripped, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.commands import endpoint
from thermostand.stand.commands.command_table import app as stand
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.running.opening.open_stand import OpenStand
from thermostand.stand.running.opening.stand_lock import find_latch_file
from thermostand.stand.running.order import load_order
from thermostand.stand.safety import latch
from thermostand.stand.safety.fault import Fault, Readings, Watch
from thermostand.stand.safety.interlock import Interlocked
from thermostand.stand.safety.latch import UNREADABLE, find_state_folder
from thermostand.stand.service.host import Host
from thermostand.stand.service.run import run_real
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.server import serve
from thermostand.stand.serving.client import Server, find_session_server, make_server
from thermostand.stand.serving.secop import make_secop_listener

FAULT = Fault("over_temperature", "thermometers.air is 61.00 degC", "hold")
NOTHING, SECOP_ERROR = "", 400


@pytest.fixture
def config_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stand of which nothing answers, and that no other test has; nor is there another one on this machine."""
    found = endpoint.list_running_sessions
    monkeypatch.setattr(endpoint, "list_running_sessions", lambda *roots: found(*roots) if roots else [])
    data: dict[str, Any] = yaml.safe_load(find_packaged("", "simulated").read_text())
    move_to_free(data, tmp_path)["recording"]["directory"] = str(tmp_path / "sessions")
    path = tmp_path / "stand.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


class Surfaces:
    """A stand without devices, as a daemon has it."""

    def __init__(self, open_stand: OpenStand, session: Path, http: Server, secop_port: int) -> None:
        self.stand, self.session, self.http, self.secop_port = open_stand.assembly.stand, session, http, secop_port
        self.guard, self.objection = open_stand.guard, None
        self.guard.watches = (Watch(self._rule, 0.0, "hold"),)

    objection: Fault | None

    def _rule(self, readings: Readings, now_ns: int) -> Fault | None:
        return self.objection

    def trip(self) -> None:
        """The guard finds it."""
        self.objection = FAULT
        self.guard.look()
        self.objection = None

    async def reset(self) -> None:
        """An operator does."""
        await asyncio.to_thread(find_session_server(self.session).order, "reset")

    async def rules(self) -> set[str]:
        """Which rule has tripped, by the answers of all surfaces."""
        state = await asyncio.to_thread(find_session_server(self.session).state)
        over_tcp = await asyncio.to_thread(self.http.state)
        shown = await asyncio.to_thread(CliRunner().invoke, stand, ["status", str(self.session), "--json"])
        status: Any = json.loads(shown.output)["stand"]
        text, code = await self.by_secop(NOTHING if state.fault is None else state.fault.text)
        answers = [each.fault and (each.fault.rule, each.fault.text) for each in (state, over_tcp)]
        answers += [status["fault"] and (status["fault"]["rule"], status["fault"]["text"])]
        answers += [(state.fault.rule if state.fault else "?", text) if text else None]
        tripped = state.fault is not None
        assert ("interlock" in state.reasons, "interlock" in status["reasons"], code >= SECOP_ERROR) == (tripped,) * 3
        assert self.is_barred() is tripped
        assert self.guard.may_permit() is False
        assert len(set(answers)) == 1
        return {NOTHING if each is None else each[0] for each in answers}

    async def by_secop(self, text: str) -> tuple[str, int]:
        """What has tripped, and the status of the run; the node looks at the stand again after a moment."""
        async with talking(self.secop_port) as talk, asyncio.timeout(20.0):
            while (status := (await talk.asked("read run:_fault"))[2][0]) != text:
                await asyncio.sleep(0.05)
            return status, (await talk.asked("read run:status"))[2][0][0]

    def is_barred(self) -> bool:
        """Whether the interlock lets nothing move."""
        try:
            self.stand.interlock.check()
        except Interlocked:
            return True
        return False


@asynccontextmanager
async def started(config_file: Path, folder: Path) -> AsyncGenerator[Surfaces]:
    """A daemon's stand that finds what is on the disk now."""
    config, port, secop_port = load_config(config_file), find_free_port(), find_free_port()
    open_stand = OpenStand(assemble(config, Hub(), WallClock()), None, ShutdownDeadline(), is_for_one=False)
    open_stand.latch.file = find_latch_file(config)
    await open_stand.latch.restore()
    open_stand.prepare()
    interface = Interface(folder, port=port, doors=(make_secop_listener(secop_port),), trusts_loopback=True)
    async with serve(StandService(Host(open_stand)), folder / "cycle", config.name, interface):
        await asyncio.sleep(0)
        yield Surfaces(open_stand, folder / "cycle", make_server(f"http://127.0.0.1:{port}", None), secop_port)
    await open_stand.assembly.stand.safety.close()


async def rules_after(config_file: Path, folder: Path) -> set[str]:
    """Which rule has tripped: for a run that would begin now, for `stand status` without a daemon, and for all surfaces
    of the next daemon."""
    order = load_order("warm-up", str(config_file))
    try:
        await run_real(order, folder / "sessions", lambda hub: None)
    except StandTripped:
        refused = True
    except Unreachable:
        refused = False
    alone = await asyncio.to_thread(CliRunner().invoke, stand, ["status", "--config", str(config_file)])
    assert alone.exit_code == 1, alone.output
    found = find_latch_file(load_config(config_file)).read()
    assert ((found is not None), ("has tripped" in alone.output + str(alone.exception))) == (refused, refused)
    async with started(config_file, folder) as surfaces:
        return await surfaces.rules() | {NOTHING if found is None else found.rule}


def whole() -> list[Path]:
    return sorted(find_state_folder().iterdir())


def never(_: Path) -> None:
    """Nothing was ever written."""


def tripped(config_file: Path) -> None:
    find_latch_file(load_config(config_file)).keep(FAULT, 5)


def killed_before_the_rename(config_file: Path) -> None:
    tripped(config_file)
    first, *others = whole()
    first.rename(first.with_name(f".{first.name}.0a1b.part"))
    for path in others:
        path.unlink()


def one_of_two_forgotten(config_file: Path) -> None:
    tripped(config_file)
    whole()[0].unlink()


def garbage(config_file: Path) -> None:
    tripped(config_file)
    for path in whole():
        path.write_bytes(b"\x00garbage")


def unreadable(config_file: Path) -> None:
    tripped(config_file)
    for path in whole():
        path.unlink()
        path.mkdir()


def of_another_stand(config_file: Path) -> None:
    """What is latched of a neighbour is none of ours."""
    data: dict[str, Any] = yaml.safe_load(config_file.read_text())
    data["bus"]["address"] = f"tcp:127.0.0.1:{find_free_port()}"
    neighbour = config_file.with_name("neighbour.yaml")
    neighbour.write_text(yaml.safe_dump(data))
    tripped(neighbour)


def without_its_folder(config_file: Path) -> None:
    tripped(config_file)
    shutil.rmtree(find_state_folder())


def a_folder_that_is_none(config_file: Path) -> None:
    find_state_folder().parent.mkdir(parents=True, exist_ok=True)
    find_state_folder().write_text("")


def reset(config_file: Path) -> None:
    tripped(config_file)
    find_latch_file(load_config(config_file)).reset()


def cleared_and_tripped_again(config_file: Path) -> None:
    reset(config_file)
    tripped(config_file)


@pytest.mark.parametrize(
    ("left", "rule"),
    [
        (never, NOTHING),
        (tripped, FAULT.rule),
        (killed_before_the_rename, UNREADABLE),
        (one_of_two_forgotten, FAULT.rule),
        (garbage, UNREADABLE),
        (unreadable, UNREADABLE),
        (of_another_stand, NOTHING),
        (without_its_folder, NOTHING),
        (a_folder_that_is_none, UNREADABLE),
        (reset, NOTHING),
        (cleared_and_tripped_again, FAULT.rule),
    ],
)
async def test_every_surface_of_a_new_program_says_what_was_left(
    config_file: Path, tmp_path: Path, left: Callable[[Path], None], rule: str
):
    left(config_file)
    assert await rules_after(config_file, tmp_path) == {rule}


async def test_a_disk_that_hangs_when_the_latch_is_read_counts_as_latched(
    config_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    hanging = threading.Event()
    monkeypatch.setattr(latch, "_READ_WITHIN_S", 0.05)
    monkeypatch.setattr(latch, "_read_latch", lambda _: hanging.wait())
    assert await rules_after(config_file, tmp_path) == {UNREADABLE}
    hanging.set()


async def test_every_surface_follows_a_trip_its_clearing_and_the_next_trip(config_file: Path, tmp_path: Path):
    async with started(config_file, tmp_path) as surfaces:
        assert await surfaces.rules() == {NOTHING}
        for _ in range(2):
            surfaces.trip()
            assert await surfaces.rules() == {FAULT.rule}
            async with started(config_file, tmp_path / "again") as restarted:  # as if it had been killed now
                assert await restarted.rules() == {FAULT.rule}
            await surfaces.reset()
            assert await surfaces.rules() == {NOTHING}
            assert whole() == []
        surfaces.guard.latch.trip(replace(FAULT, ends_itself=True))
        surfaces.guard.latch.hold_gate()
        assert await surfaces.rules() == {FAULT.rule}
        assert whole() == []  # what ends by itself ends with the program, too


async def test_a_disk_that_hangs_when_it_trips_hides_nothing_from_any_surface(config_file: Path, tmp_path: Path):
    hanging = threading.Event()
    async with started(config_file, tmp_path) as surfaces:
        assert surfaces.guard.latch.file is not None
        surfaces.guard.latch.file.run = lambda *_: hanging.wait()
        surfaces.trip()
        assert await surfaces.rules() == {FAULT.rule}
        hanging.set()
