"""The stock Aravis fake camera (arv-fake-gv-camera) in a process of its own: a GigE Vision peer no one here wrote."""

import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator

import pytest

ADDRESS = "127.0.0.1"  # the only one it takes: it listens on addresses of interfaces
SERIAL = f"TS{os.getpid()}"
_PROGRAM = "arv-fake-gv-camera-0.8"
_DISCOVERY = bytes.fromhex("42 01 0002 0000 ffff")
_START_LIMIT_S = 20.0  # another test run on this machine may hold the port


def answers() -> bool:
    """Whether the camera we started answers, not that of another test run."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.settimeout(0.2)
        probe.connect((ADDRESS, 3956))
        try:
            probe.send(_DISCOVERY)
            return SERIAL.encode() in probe.recv(1024)
        except OSError:
            return False


def run_stock_camera() -> Iterator[None]:
    """Runs it until the generator is closed; skips where it is missing, but fails in CI."""
    if shutil.which(_PROGRAM) is None:
        if os.environ.get("CI") == "true":
            pytest.fail(f"{_PROGRAM} is missing: apt-get install aravis-tools libaravis-0.8-0")
        pytest.skip(f"{_PROGRAM} is missing")
    deadline_s = time.monotonic() + _START_LIMIT_S
    # setpriv: it must not outlive a test run that is killed, for it would keep the port from the next one.
    command = ["setpriv", "--pdeathsig", "KILL", _PROGRAM, "-i", ADDRESS, "-s", SERIAL]
    while True:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        while process.poll() is None and not (answering := answers()) and time.monotonic() < deadline_s:
            pass
        if process.poll() is None and answering:
            break
        process.kill()
        process.wait()
        if time.monotonic() > deadline_s:
            pytest.fail(f"{_PROGRAM} does not answer: is UDP port 3956 of {ADDRESS} in use by another one?")
        threading.Event().wait(0.5)
    yield
    process.kill()
    process.wait()
