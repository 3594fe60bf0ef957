"""A session that is killed every 20 s of real time until it ends, also while it is being resumed and salvaged."""

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.journals import read_lines
from tests.system.conftest import SHORT_RECIPE
from tests.system.resume_process import Daemon
from tests.system.test_resume import check, check_soaks, revived
from thermostand.stand.running.memory.entries import Ended, Gap, JournalEntry
from thermostand.stand.running.memory.journal import JOURNAL_NAME
from thermostand.stand.running.order import Order

LIFE_S = 20.0
SET_POINTS = [30, 20, 24, 32, 20, 28, 22, 34, 26, 20, 30, 24] * 4
# A dwell fits into one life also on a machine that others load: a chamber that was left alone has to soak again.
RECIPE = (
    SHORT_RECIPE.replace("600", "300")
    .replace("[30, 20, 24]", str(SET_POINTS))
    .replace("frames_per_point: 1", "frames_per_point: 6")
)


@pytest.mark.nightly
def test_a_session_killed_every_20_s_of_real_time_comes_to_its_end_and_loses_nothing(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered, out, rng = order(RECIPE), tmp_path / "out", random.Random(20)
    acknowledged, unresumed, lives = list[int](), 0, 1
    daemon = Daemon(ordered, out)
    while not is_over(daemon, LIFE_S, out):
        acknowledged += daemon.acknowledged
        daemon = revived(ordered, out)
        for _ in range(rng.randrange(4)):  # killed while it salvages, reads the session, or opens the devices
            if daemon.lives_for(1, "resuming") and not is_over(daemon, rng.choice([0.02, 0.1, 0.3, 1.0, 3.0]), out):
                unresumed += not daemon.is_resumed
                acknowledged += daemon.acknowledged
                daemon = revived(ordered, out)
        lives += 1
        assert lives < 200, "the night does not get on"
    (directory,) = out.iterdir()
    check(directory, ordered, acknowledged + daemon.acknowledged)
    check_soaks(directory, ordered)
    gaps = [entry for entry in entries(out) if isinstance(entry, Gap)]
    assert lives > 3
    assert unresumed > 1
    assert len(gaps) > 3


def is_over(daemon: Daemon, real_s: float, out: Path) -> bool:
    """Whether the session came to its end within that time; else the daemon is killed. It may also be killed just after
    the end was written."""
    if daemon.ends_within(real_s):
        return True
    last = entries(out)[-1:]
    return bool(last) and isinstance(last[0], Ended) and last[0].status == "complete"


def entries(out: Path) -> list[JournalEntry]:
    """The journal of the only session; nothing when none has begun."""
    return [entry for path in out.glob(f"*/{JOURNAL_NAME}") for entry in read_lines(path.read_bytes())[0]]
