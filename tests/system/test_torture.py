"""Drawn stands, plans, faults and orders that are known to be interesting break no invariant: docs/how-to."""

from __future__ import annotations

import os
import random
import signal
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from tests.system.conftest import require_aravis
from tests.torture.case import PLAIN, Case, Fault, read_case
from tests.torture.lives import live
from tests.torture.rig import compute_digests, perform

CASES = sorted((Path(__file__).parents[1] / "torture" / "cases").glob("*.yaml"))


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_a_case_breaks_no_invariant(path: Path):
    require_aravis()
    result = perform(read_case(path))
    assert result.violations == ()


BUSY = Case(
    4,
    {**PLAIN, "extras": "imager, inputs, probes"},
    {
        "steps": [
            "close_flap",
            {"start_chamber": 26},
            {"soak": 120},
            "open_flap",
            {"capture": {"frames": 2, "interval_s": 10, "role": "other"}},
            "close_flap",
            "stop_chamber",
        ]
    },
    attended=True,
    faults=(
        Fault("thermometers.silent", True, 20.0, 5.0),
        Fault("linear.silent", True, 40.0, 5.0),
        Fault("bus.hangs_up", True, 50.0, 20.0),
        Fault("camera.control_lost", True, 60.0, 20.0),
        Fault("bus.mixed", 0.05, 80.0, 60.0),
    ),
)


def test_a_laboratory_that_is_stopped_now_and_then_gives_the_same_bytes(tmp_path: Path):
    """As on a machine that has other things to do: time-outs are judged in virtual time."""
    require_aravis()
    folder, has_ended, drawn, stops = tmp_path / "case", threading.Event(), random.Random(1), list[float]()

    def stop_now_and_then() -> None:
        while not has_ended.wait(drawn.uniform(0.02, 0.3)):
            for begun in folder.glob("begun-*"):
                with suppress(OSError, ValueError):  # it has ended meanwhile, or just begins
                    laboratory = int(begun.read_text())
                    os.kill(laboratory, signal.SIGSTOP)
                    threading.Event().wait(0.2)
                    os.kill(laboratory, signal.SIGCONT)
                    stops.append(0.2)

    live(BUSY, folder)
    undisturbed = compute_digests(folder)
    disturber = threading.Thread(target=stop_now_and_then)
    disturber.start()
    try:
        live(BUSY, folder)
    finally:
        has_ended.set()
        disturber.join()
    assert len(stops) > 5
    assert compute_digests(folder) == undisturbed
