"""When a flap counts as arrived, jammed or too slow, from looks with known times."""

import pytest

from thermostand.drivers.devices.motion.flap import Travel
from thermostand.foundation.clock import NS_PER_S, to_ns

Look = tuple[float, int, bool]  # s since the target was sent, position, saturated

MOVING = [(0.05 * i, 500 + 150 * i, True) for i in range(1, 20)]
STILL = [(0.05 * i, 500, True) for i in range(1, 12)]


def judged(looks: list[Look], travel_s: float = 5.0) -> list[str]:
    travel = Travel(3500, 40, travel_s, 500, NS_PER_S)
    return [travel.look(position, saturated, NS_PER_S + to_ns(time_s)) for time_s, position, saturated in looks]


def test_a_flap_that_moves_is_not_jammed() -> None:
    assert not any(judged(list(MOVING)))


def test_still_at_full_force_for_half_a_second_is_a_jam_at_the_tenth_look() -> None:
    assert judged(list(STILL))[:10] == [*[""] * 9, "jammed at 500 on the way to 3500"]


def test_still_without_force_is_no_jam() -> None:
    assert not any(judged([(time_s, position, False) for time_s, position, _ in STILL]))


@pytest.mark.parametrize("pause_s", [0.5, 3.0, 600.0])
def test_a_pause_in_which_nobody_looked_is_neither_a_jam_nor_a_late_arrival(pause_s: float) -> None:
    """As when the loop was held up by something else, or the process stopped, between two looks."""
    late = [(time_s + pause_s, position, saturated) for time_s, position, saturated in STILL[1:5]]
    assert not any(judged([STILL[0], *late]))
    assert not any(judged(late))


def test_slower_looks_find_a_jam_as_well() -> None:
    assert judged([(0.4 * i, 500, True) for i in range(1, 6)]) == [*[""] * 4, "jammed at 500 on the way to 3500"]


def test_a_flap_that_creeps_is_too_slow_after_its_time_of_being_watched() -> None:
    creeping = [(0.05 * i, 500 + 10 * i, False) for i in range(1, 103)]
    assert judged(creeping)[99:] == ["", "at 1510, not at 3500, after 5 s", "at 1520, not at 3500, after 5 s"]


def test_three_looks_within_the_tolerance_are_an_arrival() -> None:
    travel = Travel(3500, 40, 5.0, 3400, 0)
    for count, position in enumerate([3470, 3500, 3450, 3465, 3500, 3540]):
        assert not travel.has_arrived
        travel.look(position, True, to_ns(0.05 * (count + 1)))
    assert travel.has_arrived
