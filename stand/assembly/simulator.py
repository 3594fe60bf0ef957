"""Starts the simulated laboratory as a process of its own, and leads it through virtual time."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Mapping

from thermostand.drivers.camera_preset import CameraPreset
from thermostand.drivers.devices.kinds import Equipment
from thermostand.foundation.addresses import parse_tcp_address, set_display_address
from thermostand.foundation.clock import to_ns
from thermostand.foundation.documents import load_document
from thermostand.foundation.errors import ConfigError, Refused, Unreachable
from thermostand.stand.config.simulation import SimulatedCamera
from thermostand.stand.config.stand_config import StandConfig, find_packaged

_STOP_LIMIT_S = 5.0  # round number; nothing was measured
_CONNECT_S = 5.0  # it listens on this machine; not measured
_TURN_US = 10_000  # how long the event loop may wait for an answer
_CAMERA_BOOT_S = 3.0  # a stand that waits for less has a camera that takes less
_FREE_TCP, _FREE_SERIAL = "tcp:127.0.0.1:0", "serial:"


def describe_laboratory(
    config: StandConfig, *, virtual: bool, seed: int | None, start_ns: int | None = None, is_anywhere: bool = False
) -> dict[str, object]:
    """The simulator's description: which fake answers where, or `is_anywhere`: each at a free address of the same kind.
    ConfigError when the stand is not a simulated one.

    start_ns: the first instant in virtual time, else the configured one.
    """
    simulation = config.simulation
    if simulation is None:
        raise ConfigError(f"{config.name}: no `simulation` section; this is not a simulated laboratory")

    def address_of(configured: str | None) -> str | None:
        if not is_anywhere or configured is None:
            return configured
        return _FREE_SERIAL if configured.startswith(_FREE_SERIAL) else _FREE_TCP

    return {
        "virtual": virtual,
        "control": address_of(simulation.control),
        "start_ns": to_ns(simulation.start.timestamp()) if start_ns is None else start_ns,
        "seed": simulation.seed if seed is None else seed,
        "camera_kind": simulation.camera,
        "laboratory_degC": simulation.laboratory_degC,
        "chamber_seed": simulation.chamber_seed,
        "faults": list(simulation.faults),
        "bus": address_of(config.bus.address),
        "devices": {
            each.name: {"fake": fake, "settings": _make_settings(each, config, address_of, is_anywhere=is_anywhere)}
            for each in config.equipment
            if each.settings is not None and (fake := each.kind.fake(each.settings))
        },
        "camera_boot_s": min([_CAMERA_BOOT_S, *(camera.boot_s for camera in config.cameras.values())]),
    }


def _make_settings(
    each: Equipment, config: StandConfig, address_of: Callable[[str | None], str | None], *, is_anywhere: bool
) -> dict[str, object]:
    """Make the settings as the stand's file has them, with the address at which the fake is to answer, and what it
    needs of the rest."""
    name, kind, settings = each
    if kind.section == "cameras":
        dress = _describe_camera(config.simulation.cameras.get(name, SimulatedCamera())) if config.simulation else {}
        address = None if is_anywhere else settings.address
        return {"address": address, "serial_number": settings.serial_number, **dress}
    data: dict[str, object] = settings.model_dump(mode="json")
    if kind.section == "imager":
        return data | ({"folder": None} if is_anywhere else {})
    if kind.address_key:
        data[kind.address_key] = address_of(getattr(settings, kind.address_key))
    if kind.section == "thermometer_module":
        data["channels"] = {name: entry.channel for name, entry in config.sensors.items()}
    if kind.section == "climate_chamber":
        data["limits_degC"] = list(settings.limits_at_panel_degC or config.limits.chamber_degC)
    return data


def _describe_camera(camera: SimulatedCamera) -> dict[str, object]:
    """Optics and the GenICam file, the latter from where we are. ConfigError where the optics' file cannot be read."""
    genicam = None if camera.genicam is None else str(camera.genicam.resolve())
    if not camera.is_preset:
        return {"optics": camera.optics, "genicam": genicam}
    preset = load_document(find_packaged("optics", str(camera.optics)), CameraPreset)
    return {
        "preset": preset.model_dump(),
        "effects": list(camera.effects),
        "drawn": camera.drawn,
        "genicam": genicam,
    }


def relocate(config: StandConfig, addresses: Mapping[str, str]) -> StandConfig:
    """The same stand with every device of its simulated laboratory at these addresses (Simulator.addresses), of which
    messages say what the file of `config` states."""
    moved = {
        name: settings.model_validate({**settings.model_dump(exclude_unset=True), kind.address_key: addresses[name]})
        for name, kind, settings in config.equipment
        if settings is not None and kind.address_key
    }
    for name, kind, settings in config.equipment:
        if name in moved and (address := getattr(settings, kind.address_key)):
            set_display_address(addresses[name], address)
    set_display_address(addresses["bus"], config.bus.address)
    update = config.replace_settings(moved) | {"bus": config.bus.model_copy(update={"address": addresses["bus"]})}
    simulation = config.simulation
    update["simulation"] = simulation and simulation.model_copy(update={"control": addresses["control"]})
    return config.model_copy(update=update)


def list_faults() -> list[dict[str, object]]:
    """The simulator's table of faults: name, worst, mended, text."""
    found = subprocess.run(
        [sys.executable, "-m", "thermostand.drivers.sim", "--faults"], capture_output=True, text=True, check=True
    )
    rows: list[dict[str, object]] = json.loads(found.stdout)
    return rows


class Simulator:
    """A running simulator process; `addresses` says where each device and the control socket answers. module: what
    simulates; tests have one that also writes down what truly happens."""

    module = "thermostand.drivers.sim"

    def __init__(self, laboratory: Mapping[str, object]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", self.module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # more threads render no faster and starve the daemon
            start_new_session=True,  # Ctrl-C reaches the daemon first, which makes the stand safe and then ends this
        )
        if self._process.stdin is None or self._process.stdout is None or self._process.stderr is None:
            raise ValueError("the simulator was started without its pipes")
        self._process.stdin.write(json.dumps(laboratory))
        self._process.stdin.close()
        line = self._process.stdout.readline()
        if not line:
            reason = self._process.stderr.read().strip().splitlines()
            self.stop()
            ended = f"it printed nothing and ended with status {self._process.returncode}"
            raise ConfigError(f"the simulator did not start: {reason[-1] if reason else ended}")
        self.addresses: dict[str, str] = json.loads(line)

    def stop(self) -> None:
        """End the process; may be called twice."""
        self._process.terminate()
        try:
            self._process.wait(_STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()


class ControlSocket:
    """The simulator's control socket: one JSON object a line in, one out. An answer is waited for on the spot, since it
    comes within a ms; the event loop has its turn every 10 ms of one that takes longer."""

    def __init__(self, address: str) -> None:
        self._place = parse_tcp_address(address)
        self._socket: socket.socket | None = None
        self._settling: socket.socket | None = None  # an `advance` may be under way on the other one

    async def open(self) -> None:
        """Connect; raises Unreachable."""
        try:
            opened = await asyncio.to_thread(socket.create_connection, self._place, _CONNECT_S)
        except OSError as error:
            host, port = self._place
            raise Unreachable("simulator", f"nobody listens at {host}:{port} ({error})") from error
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        opened.settimeout(None)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", 0, _TURN_US))
        self._socket = opened

    async def request(self, request: Mapping[str, object]) -> dict[str, object]:
        """Send one request and return its answer; Unreachable when the simulator is gone, Refused when it refuses."""
        return _parse_answer(await self._answer(json.dumps(request).encode() + b"\n"))

    async def _answer(self, line: bytes) -> bytes:
        """The line that answers; Unreachable."""
        if self._socket is None:
            raise ValueError("the control socket is not open")
        try:
            self._socket.sendall(line)
            answer = b""
            while not answer.endswith(b"\n"):
                answer += await self._receive(self._socket)
        except OSError as error:
            raise Unreachable("simulator", f"the control socket broke ({error})") from error
        return answer

    async def _receive(self, opened: socket.socket) -> bytes:
        while True:
            try:
                data = opened.recv(65536)
            except BlockingIOError:
                await asyncio.sleep(0)
                continue
            if not data:
                raise Unreachable("simulator", "the simulator closed its control socket")
            return data

    async def advance(self, now_ns: int) -> None:
        """Put the simulated laboratory at `now_ns`; raises as `request`."""
        line = await self._answer(b'{"do": "advance", "now_ns": %d}\n' % now_ns)
        if line != b'{"now_ns": %d}\n' % now_ns:
            _parse_answer(line)

    def settle(self) -> None:
        """Block until the simulated devices have answered all that has arrived at them; at once when the simulator is
        gone."""
        try:
            if self._settling is None:
                self._settling = socket.create_connection(self._place, _CONNECT_S)
                self._settling.settimeout(None)
            self._settling.sendall(b'{"do": "settle"}\n')
            while not self._settling.recv(65536).endswith((b"\n", b"")):
                pass
        except OSError:
            self._close_settling()

    def _close_settling(self) -> None:
        if self._settling is not None:
            self._settling.close()
        self._settling = None

    async def close(self) -> None:
        """Let go; may be called twice."""
        self._close_settling()
        if self._socket is not None:
            self._socket.close()
        self._socket = None


def _parse_answer(line: bytes) -> dict[str, object]:
    """Return what the simulator answered; Refused when it refuses."""
    answer: dict[str, object] = json.loads(line)
    if "error" in answer:
        raise Refused("simulator", str(answer["error"]))
    return answer
