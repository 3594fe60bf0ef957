"""What the program gave before its inside was built again, it gives now: `python -m tests.golden`."""

import json
from typing import Any

import pytest

from tests.golden.__main__ import GOLDENS, OFFERED, SESSIONS, find_differences, load_golden, round_trip


@pytest.mark.parametrize("name", [*OFFERED, *(pytest.param(name, marks=pytest.mark.nightly) for name in SESSIONS)])
def test_nothing_differs_from_what_is_kept(name: str):
    """Where openapi and help change with a reason: python -m tests.golden make."""
    assert list(find_differences(load_golden(name), round_trip(GOLDENS[name]()))) == []


@pytest.mark.parametrize(
    ("before", "now", "places"),
    [
        ({"a": [1.0, 2.0]}, {"a": [1.0 + 1e-10, 2.0]}, []),
        ({"a": [1.0, 2.0]}, {"a": [1.0 + 1e-8, 2.0]}, ["/a/0"]),
        ({"a": 10**18}, {"a": 10**18 + 1}, ["/a"]),
        ({"a": 1, "b": 2}, {"a": 1.0, "c": 2}, ["/b", "/c"]),
        ([1, 2], [1], [""]),
        ("one\ntwo", "one\n2", ["/1"]),
        (float("nan"), float("nan"), []),
        (True, 1, [""]),
    ],
)
def test_each_difference_is_reported_with_its_place(before: Any, now: Any, places: list[str]):
    assert [each.partition(":")[0] for each in find_differences(before, json.loads(json.dumps(now)))] == places
