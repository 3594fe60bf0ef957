"""The one place where the goldens meet the product: what a user types, `import thermostand`, and the served document.

When a part of it gets another name, it is changed here, and what is kept stays comparable.
"""

from __future__ import annotations

import asyncio
import hashlib
import http.client
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from typer.main import get_command

import thermostand
from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.page_service import TARGET, free_port
from thermostand.compensation.cli import app as compensate
from thermostand.stand.commands.command_table import app as stand
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.page_data import PageData
from thermostand.stand.serving.page_routes import PageRoutes

APPS = {"stand": stand, "compensate": compensate}
_KEPT = 48
"""Of the values of a channel so many are kept as they are, spread over the session; the others count in sums."""


def run(folder: Path, recipe: str | Path) -> Path:
    """The session of the recipe in virtual time with seed 7; its folder is alone in `folder`."""
    _do("stand", "run", recipe, "--virtual-time", "--seed", "7", "--out", folder)
    (session,) = (path for path in folder.iterdir() if path.is_dir())
    return session


def offline(*arguments: str | Path) -> None:
    """What `compensate` does with it."""
    _do("compensate", *arguments)


def _do(program: str, *arguments: str | Path) -> None:
    # With threads OpenCV sums in another order each time: a calibration then differs by up to 1e-7.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
    command = [str(Path(sys.executable).with_name(program)), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-2000:]}")


def summarise_session(path: Path) -> dict[str, Any]:
    """By value: readings, steps, events and frames of a session. Sums are weighted, so that an exchange shows."""
    session = thermostand.session(path)
    steps = [
        [each.time_ns, each.step_id, each.kind, str(each.state), dict(each.parameters)] for each in session.steps()
    ]
    events = [[each.time_ns, each.level, each.kind, each.text, dict(each.data)] for each in session.events()]
    readings = {name: _column(*session.readings(name)) for name in session.channels()}
    return {
        "units": dict(session.units()),
        "readings": readings,
        "steps": steps,
        "events": events,
        "frames": list(_frames(session)),
    }


def _column(time_ns: Any, value: Any) -> dict[str, Any]:
    weights = np.random.default_rng(len(value)).choice([-1.0, 1.0], len(value))
    chosen = np.unique(np.linspace(0, len(value) - 1, _KEPT).astype(int)) if len(value) else []
    good = np.nan_to_num(value)
    return {
        "count": len(value),
        "bad": int(np.isnan(value).sum()),
        "sum": float(good.sum()),
        "weighted": float((weights * good).sum()),
        "time_sum_s": int((time_ns - time_ns[:1]).sum()) / 1e9,
        "values": [[int(time_ns[each]), float(value[each])] for each in chosen],
    }


def _frames(session: thermostand.Session) -> Iterator[dict[str, Any]]:
    """Each frame as it was recorded, and where the markers are in it by our own detection."""
    table = session.frames_table()
    target = thermostand.load_target(find_packaged("targets", "paper-9x6"))
    for row, frame in enumerate(session.frames()):
        facts = {name: column[row].item() for name, column in table.columns().items() if name != "file"}
        try:
            centres = thermostand.detect(frame.image, target).centres_px.round(9).tolist()
        except thermostand.DetectionError as error:
            centres = [str(error)]
        yield {
            **facts,
            "exposure_s": frame.exposure_s,
            "gain_dB": frame.gain_dB,
            "shape": list(frame.image.shape),
            "sum": int(frame.image.sum(dtype=np.int64)),
            "pixels": hashlib.blake2b(np.ascontiguousarray(frame.image).tobytes(), digest_size=8).hexdigest(),
            "centres_px": centres,
        }


def openapi() -> dict[str, Any]:
    """The document of the HTTP interface, with the page's part."""
    return asyncio.run(_document())


async def _document() -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        desk, port = FakeService(), free_port()
        routes = (PageRoutes(PageData(desk.hub, desk.clock, Path(folder), TARGET)),)
        async with serve_fake(desk, Path(folder, "now"), Interface(Path(folder), port=port, extra_routes=routes)):
            return json.loads(await asyncio.to_thread(_get, port, "/openapi.json"))


def _get(port: int, path: str) -> bytes:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    connection.request("GET", path)
    return connection.getresponse().read()


def commands() -> Iterator[tuple[tuple[str, ...], Any]]:
    """Each program and each of its commands with its path, as ("stand", "queue", "add")."""
    for program, app in APPS.items():
        yield from ((path, command) for path, command, _ in _commands(get_command(app), (program,)))


def helps() -> dict[str, str]:
    """What --help of each of them says, in plain text."""
    found = (each for program, app in APPS.items() for each in _commands(get_command(app), (program,)))
    return {" ".join(path): command.get_help(context) for path, command, context in found}


def _commands(command: Any, path: tuple[str, ...], parent: Any = None) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    command.rich_markup_mode = None
    context = command.context_class(command, info_name=path[-1], parent=parent, terminal_width=100)
    yield path, command, context
    for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
        _, found, _ = command.resolve_command(context, [name])
        yield from _commands(found, (*path, name), context)
