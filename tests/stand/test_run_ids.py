"""Ids of steps behave as a frozenset does, and earlier ones stay what they were."""

from hypothesis import given
from hypothesis import strategies as st

from thermostand.stand.running.memory.state import Ids

IDS = st.sampled_from([f"step-{number}" for number in range(40)])


@given(st.lists(st.tuples(st.booleans(), IDS), max_size=60))
def test_they_are_a_set_that_never_changes(changes: list[tuple[bool, str]]):
    ids, plain, earlier = Ids(), frozenset[str](), []
    for adds, step_id in changes:
        earlier.append((ids, plain))
        ids = ids.plus(step_id) if adds else ids.minus({step_id})
        plain = plain | {step_id} if adds else plain - {step_id}
    for kept, expected in [*earlier, (ids, plain)]:
        assert kept == expected
        assert sorted(kept) == sorted(expected)
        assert len(kept) == len(expected)


def test_adding_many_keeps_few_parts():
    """A lookup asks each part: of 1000 ids at most 10."""
    ids = Ids()
    for number in range(1000):
        ids = ids.plus(str(number))
    assert len(ids) == 1000
    assert len(ids._parts) <= 10
    assert "999" in ids
    assert "1000" not in ids
