"""No order of stops, kills, lost looks and other masters heats for longer than is stated: all of them, by spin."""

import shutil
import subprocess
from pathlib import Path

import pytest

from thermostand.stand.chamber.chamber import SUPERVISION_PERIOD_S
from thermostand.stand.config.guard_section import GuardConfig
from thermostand.stand.guarding.guard import LATE_PERIODS

MODEL = Path(__file__).with_name("dead_man.pml")
GUARD = GuardConfig()
TIMES_S = {
    "HOLD": GUARD.heater_hold_s,
    "RENEW": GUARD.heater_renew_s,
    "LATE": LATE_PERIODS * GUARD.period_s,
    "STALE": GUARD.stale_after_s,
    "LOOK": SUPERVISION_PERIOD_S,
    "BUS": 1.0,  # three tries of 0.3 s (drivers/wires/modbus_client.py, bus.py)
}
BOUND_S = 33
"""Of heat after the last look of a guard (docs/explanation/safety.md)."""


def broken(folder: Path, *changes: str) -> bool:
    """Whether a state can be reached in which one of the model's assertions does not hold."""
    times = [f"-D{name}={-(-value // 1):.0f}" for name, value in TIMES_S.items()]
    subprocess.run(["spin", *times, *changes, "-a", MODEL], cwd=folder, check=True)
    subprocess.run(["gcc", "-O2", "-DSAFETY", "-o", "pan", "pan.c"], cwd=folder, check=True)
    done = subprocess.run(["./pan", "-m2000000", "-w24"], cwd=folder, capture_output=True, text=True, check=True)
    assert "max search depth" not in done.stdout
    return (folder / f"{MODEL.name}.trail").exists()


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("spin") is None, reason="spin is not installed (Debian: spin)")
@pytest.mark.parametrize(
    ("changes", "is_broken"),
    [
        ([f"-DBOUND={BOUND_S}"], False),
        ([f"-DBOUND={BOUND_S - 1}"], True),  # it is no looser than it must be
        (["-DNO_LATE"], True),  # permits that do not ask when the guard looked last
        (["-DNO_TIMER"], True),  # a board that holds its relay
    ],
    ids=["bound", "tight", "no late look", "no timer"],
)
def test_heat_ends_after_the_last_look_of_a_guard_in_every_order_of_events(
    tmp_path: Path, changes: list[str], is_broken: bool
):
    assert broken(tmp_path, *changes) == is_broken
