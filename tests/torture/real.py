"""The second leg: a case in real time. `stand serve` has a simulated laboratory of its own on real wires and a disk of
its own; processes, disk, clock and doors are broken meanwhile. A seed gives the schedule again, not the bytes.

A kind of fault is a generator under `@kind`: what it does, a `yield` for as long as it lasts, and what undoes it.
"""

from __future__ import annotations

import http.client
import itertools
import json
import math
import os
import random
import resource
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests import fork_server
from tests.addresses import WORKER, allocate_camera_address, find_free_port, move_to_free
from tests.recording.disks import ext4
from tests.sections import change
from tests.stand.floods import FLOODS
from tests.system.conftest import CORNER
from tests.torture.case import (
    CHAMBERS,
    LEFT_OUT,
    Case,
    Fault,
    Order,
    draw_faults,
    draw_stand,
    stand_document,
    write_case,
)
from tests.torture.laboratory import FOLDER, LIFE
from tests.torture.lives import HIDDEN, ROOT, Life, find_folder
from tests.torture.operator_actions import OperatorActions
from thermostand.drivers.sim.laboratory_faults import FAULTS
from thermostand.foundation.addresses import parse_tcp_address
from thermostand.foundation.clock import NS_PER_S, WallClock, to_ns
from thermostand.foundation.errors import SessionError
from thermostand.recording.writing.disk import MODULE
from thermostand.stand.assembly.simulator import describe_laboratory
from thermostand.stand.config.stand_config import load_config
from thermostand.stand.serving.client import Server, find_session_server

BUSY_S = 40.0  # in which things break
AFTER_S = 7.0
LIMIT_S, LEAVES_S = 240.0, 60.0  # until the plan is complete, all else mended; until a daemon has left
LOOK_S, AGAIN_S, RESETS_EACH_S = 0.5, 1.0, 5.0  # of the operator; until the daemon is started again; between two resets
MOST_ORDERS, MOST_KILLS = 6, 2
PRESSED_S = 10.0  # after which a STOP is given up
DISK_BYTES = 6 << 30
_LEAST = 19  # priority of a process that everything else goes before
# What takes a stand seconds takes this one a part of one, but no less than a busy machine needs for it.
PACE: dict[str, dict[str, object]] = {
    "regulator": {"poll_s": 0.5},
    "climate_chamber": {"poll_s": 0.5},
    "thermometer_module": {"poll_s": 0.5},
    "relays": {"poll_s": 1.0, "self_test_s": 0.6},
    "flap": {"poll_s": 1.0},
    "guard": {"period_s": 0.5, "heater_hold_s": 4.0, "heater_renew_s": 1.0},
    "heat_module": {"watchdog_s": 4.0},
    "recording": {"telemetry_commit_s": 0.5, "stop_frames_below_GB": 0.5, "alert_below_percent": 0},
    "bus": {"timeout_s": 0.5},
}
CAMERA = {"poll_s": 1.0, "boot_s": 0.2, **CORNER}
PULSES = {"sample_s": 0.5, "pulses": {"cycle_s": 2, "min_on_s": 0.1, "min_off_s": 0.1}}
BRIEF = {"min_off_s": 8, "min_on_s": 2, "max_starts_per_h": 60}  # of the compressor
MOVED = ROOT / "tests/system/moved_clocks"
MOUNTS = os.geteuid() == 0  # who may not has no disk that hangs or is full

Does = Callable[["Bench", Order], Iterator[None]]


@dataclass(frozen=True, slots=True)
class Kind:
    """lasts_s: how long, one of these. means: the begins of the names of faults that it is as good as."""

    does: Callable[[Bench, Order], AbstractContextManager[None]]
    lasts_s: tuple[float, ...]
    means: tuple[str, ...]


KINDS: dict[str, Kind] = {}


def kind(*lasts_s: float, means: tuple[str, ...] = ()) -> Callable[[Does], Does]:
    """Enter it under its name."""

    def enter(does: Does) -> Does:
        KINDS[does.__name__] = Kind(contextmanager(does), lasts_s or (0.0,), means)
        return does

    return enter


# Processes


@kind(0.5, 2.0, 5.0, 12.0)
def daemon_stopped(bench: Bench, order: Order) -> Iterator[None]:
    """Shorter and longer than the relay's time."""
    with bench.stopped(bench.daemon.pid):
        bench.doors.note(order, bench.now_ns(), None)
        yield


@kind()
def terminated(bench: Bench, order: Order) -> Iterator[None]:
    bench.daemon.send_signal(bench.drawn(order, (signal.SIGTERM, signal.SIGINT)))
    yield


@kind()
def disk_process_killed(bench: Bench, order: Order) -> Iterator[None]:
    os.kill(bench.drawn(order, bench.disk_processes()), signal.SIGKILL)
    yield


@kind(1.0, 4.0, 10.0)
def disk_process_stopped(bench: Bench, order: Order) -> Iterator[None]:
    with bench.stopped(bench.drawn(order, bench.disk_processes())):
        yield


EVERY_DEVICE = ("bus", "relays", "chamber", "flap", "thermometer", "camera", "regulator", "heater", "heat_module")


@kind(1.0, 4.0, 10.0, means=EVERY_DEVICE)
def laboratory_stopped(bench: Bench, order: Order) -> Iterator[None]:
    """No device answers."""
    with bench.stopped(bench.laboratory.pid):
        yield


@kind(0.5, 5.0, means=EVERY_DEVICE)
def laboratory_killed(bench: Bench, order: Order) -> Iterator[None]:
    """A power cut of all but the computer; then another one, with everything off, answers at the same addresses."""
    bench.laboratory.kill()
    bench.laboratory.wait()
    yield
    bench.begin_laboratory()


# The disk


@kind(2.0, 5.0, 10.0)
def disk_hangs(bench: Bench, order: Order) -> Iterator[None]:
    bench.freeze("-f")
    yield
    bench.freeze("-u")


@kind(2.0, 5.0, 10.0)
def disk_refuses(bench: Bench, order: Order) -> Iterator[None]:
    """No file of the disk processes grows (EFBIG)."""
    pids, hard = bench.disk_processes(), resource.RLIM_INFINITY
    for pid in pids:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, hard))
    yield
    for pid in pids:
        with suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))


@kind(2.0, 5.0, 10.0)
def disk_is_full(bench: Bench, order: Order) -> Iterator[None]:
    ballast = bench.disk / "ballast"
    if MOUNTS:
        with ballast.open("wb") as file, suppress(OSError):
            os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(bench.disk).free)
    yield
    ballast.unlink(missing_ok=True)


@kind(1.0, 5.0, 10.0)
def folder_lost(bench: Bench, order: Order) -> Iterator[None]:
    name = bench.session()
    if name:
        (bench.disk / "out" / name).rename(bench.disk / HIDDEN / name)
    yield
    find_folder(bench.disk)


# The clock, the doors, the bus


@kind()
def clock_stepped(bench: Bench, order: Order) -> Iterator[None]:
    bench.step_ns += to_ns(bench.drawn(order, (5.0, -5.0, 3600.0, -3600.0)))
    bench.write_clocks()
    yield


@kind(4.0, 8.0)
def flooded(bench: Bench, order: Order) -> Iterator[None]:
    """And STOP pressed in it."""
    program = [sys.executable, "-S", str(ROOT / "tests/stand/floods.py"), bench.drawn(order, tuple(FLOODS))]
    env = {**os.environ, "PORTS": f"{bench.port} {bench.secop}"}
    with subprocess.Popen(program, env=env, stdout=subprocess.DEVNULL) as process:
        try:
            time.sleep(1.0)  # noqa: TID251 - of real time
            bench.press_stop(order)
            yield
        finally:
            process.kill()


@kind()
def stop_pressed(bench: Bench, order: Order) -> Iterator[None]:
    bench.press_stop(order)
    yield


@kind()
def another_orders(bench: Bench, order: Order) -> Iterator[None]:
    """A second client wants what the run does not."""
    path, arguments = bench.drawn(
        order, (("regulator/set", {"setpoint_degC": 40.0}), ("flap/open", {}), ("linear/move", {"position": 3.0}))
    )
    answer = bench.doors.asked("POST", f"devices/{path}", {"arguments": arguments})
    bench.doors.note(order, bench.now_ns(), answer)
    yield


@kind(3.0, 8.0)
def paused(bench: Bench, order: Order) -> Iterator[None]:
    bench.doors.give(replace(order, verb="pause"), bench.now_ns())
    yield
    bench.doors.give(replace(order, verb="continue"), bench.now_ns())


def _given(bench: Bench, order: Order) -> Iterator[None]:
    bench.doors.give(order, bench.now_ns())
    yield


for _verb in ("reset", "skip", "extend", "note", "switch_on", "switch_off"):
    KINDS[_verb] = Kind(contextmanager(_given), (0.0,), ())


def draw_real(seed: int) -> Case:
    """The case of a seed."""
    drawn = random.Random(f"real {seed}")
    stand = draw_stand(drawn)
    left = {name for name in (*FAULTS, *KINDS, "kill") if drawn.random() >= LEFT_OUT}
    verbs = [name for name in KINDS if name in left and (MOUNTS or name not in ("disk_hangs", "disk_is_full"))]
    orders = [_draw_order(drawn, verb) for verb in drawn.choices(verbs, k=drawn.randint(1, MOST_ORDERS))]
    kills = drawn.randint(0, MOST_KILLS) if "kill" in left else 0
    return Case(
        seed,
        stand,
        _plan(drawn, stand),
        chamber_seed=drawn.choice((None, drawn.randrange(1000))),
        drawn_order=False,
        faults=tuple(draw_faults(drawn, stand, left & FAULTS.keys(), BUSY_S, (1.0, 4.0, 12.0), most=3)),
        orders=tuple(orders),
        kills_s=tuple(sorted(round(drawn.uniform(3.0, BUSY_S), 1) for _ in range(kills))),
        is_real=True,
    )


def _draw_order(drawn: random.Random, verb: str) -> Order:
    body = {"for_s": drawn.choice(KINDS[verb].lasts_s), "draw": round(drawn.random(), 3)}
    return Order(verb, round(drawn.uniform(1.0, BUSY_S), 1), body)


def _plan(drawn: random.Random, stand: dict[str, str]) -> dict[str, list[Any]]:
    steps: list[Any] = ["close_flap", {"start_chamber": 25}, {"soak": 3}]
    has_cold = stand["relays"] != "no compressor" or stand["heat"] in CHAMBERS
    for _ in range(drawn.randint(1, 3)):
        steps += [{"set_temperature": drawn.choice((23 if has_cold else 24, 25, 26))}, {"soak": drawn.choice((1, 4))}]
        if stand["axes"] == "two axes" and drawn.random() < 0.5:
            steps += [{"move_to": {"linear": drawn.choice((0, 2)), "rotary": drawn.choice((-1, 1))}}]
        capture = {"frames": drawn.randint(1, 3), "interval_s": drawn.choice((0.5, 2)), "role": "fit"}
        steps += ["open_flap", {"capture": capture} if stand["cameras"] != "no camera" else {"soak": 1}, "close_flap"]
    return {"steps": [*steps, "stop_chamber"]}


def real_document(case: Case, folder: Path) -> dict[str, Any]:
    """The stand's file, at PACE; each device has a free address."""
    data = move_to_free(stand_document(case, folder), folder)
    change(data, {name: entries for name, entries in PACE.items() if data.get(name)})
    if data.get("regulator", {}).get("kind") == "software":
        data["regulator"] |= PULSES
    for camera in data["cameras"].values():
        camera |= {**CAMERA, "address": allocate_camera_address()}
    data["compressor"] = BRIEF
    data["guard"].setdefault("overrides", []).extend(f"compressor.{name}" for name in BRIEF)
    return data


class Bench:
    """Everything of one case. Instants of `clock` are those of the laboratory; the daemon's may be off by a step."""

    def __init__(self, case: Case, folder: Path, disk: Path) -> None:
        os.environ.setdefault(WORKER, str(os.getpid()))  # cases side by side have ports apart
        self.clock = WallClock()
        self.case = case
        self.disk, self._folder = disk, folder
        self.port, self.secop = find_free_port(), find_free_port()
        self.step_ns = self._offset_ns = self._laboratories = self._daemons = 0
        self._over, self._late_s, self._opened_ns, self._clears_s = threading.Event(), 0.0, 0, 0.0
        self._is_done = self._is_quiet = False
        self._stopped = Counter[int]()
        self.daemon: subprocess.Popen[str]
        self.laboratory: subprocess.Popen[str]
        (folder / "case.yaml").write_text(write_case(case))
        stand = real_document(case, folder)
        (folder / "stand.yaml").write_text(yaml.safe_dump(stand))
        self._spec = describe_laboratory(load_config(folder / "stand.yaml"), virtual=False, seed=None)
        self._control = parse_tcp_address(stand["simulation"]["control"])
        self.doors = OperatorActions(
            case, folder / "doors-0.jsonl", self._server, lambda: stand["bus"]["address"], self.session
        )
        for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
            (place := folder / name).mkdir(mode=0o700)
            os.environ[name] = str(place)
        self._env = {**os.environ, FOLDER: str(folder), fork_server.OWN_HELPERS: "1", "OPENBLAS_NUM_THREADS": "1"}
        if any(order.verb == "clock_stepped" for order in case.orders):
            self._env |= {"THERMOSTAND_MOVED_CLOCKS": str(folder / "clocks"), "PYTHONPATH": str(MOVED)}
            self.write_clocks()

    def live(self) -> list[Life]:
        """All daemons one after the other, while things break; its seconds count from when the first has answered."""
        self.begin_laboratory()
        kills = [Order("kill", at_s) for at_s in self.case.kills_s]
        works = (*self.case.orders, *self.case.faults, *kills)
        breaking = [threading.Thread(target=self._break, args=(work,)) for work in works]
        watching = threading.Thread(target=self._watch_lateness)
        lives, end_s = list[Life](), time.monotonic() + LIMIT_S
        self._begin_daemon()
        try:
            while not self._opened_ns and self.daemon.poll() is None and time.monotonic() < end_s:
                self._operate()
                self._over.wait(LOOK_S)
            self.case, end_s = replace(self.case, start_ns=self.clock.now_ns()), time.monotonic() + LIMIT_S
            for thread in (*breaking, watching):
                thread.start()
            while True:
                lives.append(self._life(breaking, end_s))
                is_hung = lives[-1].status is None
                if is_hung or time.monotonic() > end_s or (self._is_done and self._is_quiet):
                    break
                self._over.wait(AGAIN_S)
                self._begin_daemon()
            self._over.wait(AFTER_S)  # what is still on then shows
        finally:
            self._over.set()
            for thread in breaking:
                thread.join()
            self.daemon.kill()
            self.laboratory.terminate()
            self.laboratory.wait()
            self.doors.close()
        return [*lives[:-1], replace(lives[-1], left=tuple(self._left()))]

    def now_ns(self) -> int:
        """As the daemon has it."""
        return self.clock.now_ns() + self._offset_ns

    def drawn(self, order: Order, choices: Sequence[Any]) -> Any:
        """One of them; IndexError when there is none."""
        return choices[int(order.body["draw"] * len(choices))]

    def session(self) -> str:
        """The name of the run's."""
        return next((path.parent.name for path in sorted((self.disk / "out").glob("*/journal.jsonl"))), "")

    def disk_processes(self) -> list[int]:
        """Of the daemon now."""
        children = [path.read_text().split() for path in Path(f"/proc/{self.daemon.pid}/task").glob("*/children")]
        pids = {int(pid) for pid in itertools.chain(*children)}
        return sorted(pid for pid in pids if MODULE in Path(f"/proc/{pid}/cmdline").read_text().split("\0"))

    @contextmanager
    def stopped(self, pid: int) -> Iterator[None]:
        """A process stands still until all who have stopped it let it go on."""
        self._stopped[pid] += 1
        os.kill(pid, signal.SIGSTOP)
        yield
        self._stopped[pid] -= 1
        if not self._stopped[pid]:
            os.kill(pid, signal.SIGCONT)

    def freeze(self, how: str) -> None:
        """-f or -u."""
        subprocess.run(["fsfreeze", how, self.disk], check=True, capture_output=True)

    def write_clocks(self) -> None:
        """What sitecustomize.py in MOVED reads; in place, as it is mapped."""
        path = self._folder / "clocks"
        with path.open("r+b" if path.exists() else "wb") as file:
            file.write(struct.pack("qq", 0, self.step_ns))

    def begin_laboratory(self) -> None:
        """With what is still to break."""
        env = {**os.environ, FOLDER: str(self._folder), LIFE: str(self._laboratories)}
        self._laboratories += 1
        program = [sys.executable, "-m", "tests.torture.laboratory"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.laboratory = fork_server.popen(program, cwd=ROOT, env=env, text=True, start_new_session=True, **pipes)
        if self.laboratory.stdin is None or self.laboratory.stdout is None:
            raise ValueError("the laboratory was started without its pipes")
        self.laboratory.stdin.write(json.dumps(self._spec))
        self.laboratory.stdin.close()
        if not self.laboratory.stdout.readline():
            raise ValueError("the laboratory has not begun")

    def press_stop(self, order: Order) -> None:
        """By TCP and as `stand stop` does, each until it is answered, as an operator and the page try again."""
        by_tcp = Server("the daemon", url=f"http://127.0.0.1:{self.port}")
        for way, server in (("TCP", lambda: by_tcp), ("socket", self._server)):
            begun_s, self._late_s, is_answered = time.monotonic(), 0.0, False
            while not is_answered and time.monotonic() < begun_s + PRESSED_S:
                with suppress(SessionError, OSError, http.client.HTTPException):
                    is_answered = bool(server().order("stop"))
            took_s = round(time.monotonic() - begun_s, 3)
            body = {**order.body, "way": way, "took_s": took_s, "late_s": round(self._late_s, 3)}
            self.doors.note(replace(order, verb="stop_pressed", body=body), self.now_ns(), is_answered)

    def _server(self) -> Server:
        return find_session_server(self.disk / "out")

    def _break(self, order: Order | Fault) -> None:
        at_s = order.at_s - (self.clock.now_ns() - self.case.start_ns) / NS_PER_S
        if self._over.wait(max(0.0, at_s)):
            return
        if isinstance(order, Fault):
            ask = {"do": "break", "name": order.name, "value": order.value, "for_s": order.for_s}
            with suppress(OSError), socket.create_connection(self._control, 5.0) as control:
                control.sendall(json.dumps(ask).encode() + b"\n")
                control.recv(1 << 16)
            self._over.wait(order.for_s)
            return
        if order.verb == "kill":
            self.daemon.kill()
            return
        with suppress(OSError, LookupError, subprocess.SubprocessError), KINDS[order.verb].does(self, order):
            self._over.wait(order.body["for_s"])

    def _watch_lateness(self) -> None:
        """How late this process is woken is what the machine does to any."""
        while not self._over.is_set():
            begun_s = time.monotonic()
            self._over.wait(0.05)
            self._late_s = max(self._late_s, time.monotonic() - begun_s - 0.05)

    def _begin_daemon(self) -> None:
        command = ["serve", str(self._folder / "stand.yaml"), "--out", str(self.disk / "out"), "--no-reports"]
        command += ["--port", str(self.port), "--secop", str(self.secop)]
        program = [sys.executable, "-X", "faulthandler", "-m", "thermostand.stand.cli", *command]
        self._output = self._folder / f"output-{self._daemons}.txt"
        self._daemons += 1
        with self._output.open("w") as file:
            self.daemon = subprocess.Popen(program, cwd=ROOT, env=self._env, stdout=file, stderr=file, text=True)
        self._begun_ns, self._opened_ns = self.clock.now_ns(), 0

    def _life(self, breaking: Sequence[threading.Thread], end_s: float) -> Life:
        """What becomes of the daemon that has been begun."""
        gone_s, is_hung = math.inf, False
        while self.daemon.poll() is None:
            self._is_quiet = not any(thread.is_alive() for thread in breaking)
            if time.monotonic() > gone_s:
                is_hung = True
                self.daemon.send_signal(signal.SIGABRT)  # it says where it is
                self.daemon.wait()
            elif gone_s < math.inf:
                self._over.wait(0.1)
            elif time.monotonic() > end_s or (self._is_quiet and self._is_done):
                self.daemon.terminate()
                gone_s = time.monotonic() + LEAVES_S
            else:
                self._operate()
                self._over.wait(LOOK_S)
        status = None if is_hung else self.daemon.returncode
        times_ns = (self._begun_ns, self._opened_ns, self.clock.now_ns(), self._offset_ns)
        return Life([], status, "", self._output.read_text(errors="replace"), *times_ns)

    def _operate(self) -> None:
        """As an operator who wants the plan done: submit it, reset what holds it, resume it."""
        state = self.doors.asked("GET", "state")
        if isinstance(state, dict) and "queue" in state and not self._opened_ns:
            self._opened_ns = self.clock.now_ns()
            offset_ns = int(state["now_ns"]) - self._opened_ns
            self._offset_ns = offset_ns if abs(offset_ns) > 2e9 else 0  # a step, or an answer's age
        self.doors.note(Order("state", 0.0), self.now_ns(), state)
        if not isinstance(state, dict) or "queue" not in state:
            return
        last: dict[str, Any] = (state["queue"] or [{"state": "failed", "session": ""}])[-1]
        self._is_done = last["state"] == "done"
        if last["state"] == "failed" and not last["session"]:
            text = (self._folder / "plan.yaml").read_text()
            self.doors.asked("POST", "queue", {"recipe_text": text, "key": f"torture-{len(state['queue'])}"})
        elif state["fault"] or state["queue_halted"]:
            # Who resets has looked: not while the folder is away, and not twice a second while a fault lasts.
            if time.monotonic() >= self._clears_s and not any((self.disk / HIDDEN).iterdir()):
                self._clears_s = time.monotonic() + RESETS_EACH_S
                self.doors.asked("POST", "run/reset", {})
        elif last["state"] in ("failed", "stopped", "interrupted"):
            self.doors.asked("POST", f"sessions/{last['session']}/resume", {})
        elif self._is_quiet and state["phase"] == "held":
            self.doors.asked("POST", "run/continue", {})

    def _left(self) -> Iterator[str]:
        """The commands of processes that a daemon has left, 5 s later still. One that everything else goes before may
        take longer to be at the end of what it does."""
        mark, end_s, found = f"{FOLDER}={self._folder}".encode(), time.monotonic() + 5.0, dict[str, str]()
        while time.monotonic() < end_s:
            found.clear()
            for path in Path("/proc").glob("[0-9]*/environ"):
                with suppress(OSError):
                    if os.getpriority(
                        os.PRIO_PROCESS, int(path.parent.name)
                    ) < _LEAST and mark in path.read_bytes().split(b"\0"):
                        found[path.parent.name] = path.with_name("cmdline").read_text().replace("\0", " ")
            if not found:
                break
            time.sleep(0.1)  # noqa: TID251 - other processes are waited for
        yield from found.values()


@contextmanager
def _disk(folder: Path) -> Iterator[Path]:
    """One of its own, where that may be mounted."""
    with ExitStack() as stack:
        try:
            stack.enter_context(ext4(folder, DISK_BYTES))
        except pytest.skip.Exception:
            folder.mkdir(exist_ok=True)
        yield folder


def live_real(case: Case, folder: Path) -> tuple[Case, list[Life]]:
    """The case, with the instant at which it began, and what came of it; its sessions are in `folder`/out."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "plan.yaml").write_text(yaml.safe_dump({"name": "torture", **case.plan}))
    with _disk(folder / "disk") as disk:
        for name in ("out", HIDDEN):
            (disk / name).mkdir(parents=True)
        bench = Bench(case, folder, disk)
        lives = bench.live()
        find_folder(disk)
        shutil.copytree(disk / "out", folder / "out")
    return bench.case, lives
