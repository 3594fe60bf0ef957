"""Drawn stands, plans, faults and orders that are known to be interesting break no invariant: docs/how-to."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.conftest import require_aravis
from tests.torture.case import read_case
from tests.torture.rig import perform

CASES = sorted((Path(__file__).parents[1] / "torture" / "cases").glob("*.yaml"))


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_a_case_breaks_no_invariant(path: Path):
    require_aravis()
    result = perform(read_case(path))
    assert result.violations == ()
