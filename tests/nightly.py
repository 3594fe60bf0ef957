"""Parameters of tests whose statement is one of many cases: a few stand for them by day, all are run by night."""

import pytest
from _pytest.mark.structures import ParameterSet


def mark_nightly(*values: object) -> ParameterSet:
    """This set of parameters is run by `make nightly` only."""
    return pytest.param(*values, marks=pytest.mark.nightly)
