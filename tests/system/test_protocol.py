"""The paper's whole protocol, 15.8 h with every device polled at 1 Hz, in virtual time."""

from pathlib import Path

import pytest

from tests.system.conftest import require_aravis
from tests.system.protocol_run import GROWTH_LIMIT_MB, PROTOCOL, POLL_s, outcomes
from tests.system.simulated_orders import simulated_order


@pytest.mark.nightly
def test_two_whole_sessions_are_the_same_to_the_byte_and_leave_nothing_in_memory(tmp_path: Path):
    require_aravis()
    outcomes_of_two = outcomes(simulated_order(tmp_path, PROTOCOL, POLL_s), tmp_path, 2)
    assert len({outcome.digest for outcome in outcomes_of_two}) == 1
    assert all(outcome.simulated_s > 15.5 * 3600 for outcome in outcomes_of_two)
    assert max(outcome.end_MB - outcome.settled_MB for outcome in outcomes_of_two) < GROWTH_LIMIT_MB
