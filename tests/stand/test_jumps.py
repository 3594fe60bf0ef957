"""A thermometer whose value jumps, though nothing is compared with it."""

from foundation.clock import seconds_ns
from foundation.hub import Hub
from foundation.items import Batch
from foundation.readings import Reading, bad_reading
from stand.guarding.jumps import jumped

GRANITE = "thermometers.granite_outside"


def texts(values: list[tuple[float, float | None]]) -> list[str]:
    """What the rule says after each (instant s, degC; None: BAD), at looks of 1 s; the same twice in a row once."""
    hub, rule, reported = Hub(), jumped(GRANITE, 2.0, 15.0), list[str]()
    due = dict(values)
    for second in range(int(values[-1][0]) + 10):
        if second in due:
            value, now_ns = due[second], seconds_ns(second)
            reading = (
                bad_reading(GRANITE, "degC", now_ns, "open wire")
                if value is None
                else Reading(GRANITE, value, "degC", now_ns)
            )
            hub.publish(Batch("thermometers", now_ns, (reading,)))
        fault = rule(hub, seconds_ns(second))
        said = "" if fault is None else fault.text
        if said and (not reported or reported[-1] != said):
            reported.append(said)
    return reported


def test_a_jump_is_reported_with_both_values_and_once():
    (text,) = texts([(0, 24.0), (5, 24.1), (10, 27.0), (15, 27.1), (20, 27.0)])
    assert text == "thermometers.granite_outside went by +2.90 K within 5 s, to 27.00 degC: look at its cable"


def test_a_ramp_and_a_pause_between_readings_are_no_jumps():
    assert texts([(5 * n, 24.0 + 1.9 * n) for n in range(5)]) == []
    assert texts([(0, 24.0), (20, 34.0), (25, 34.1)]) == []


def test_a_jump_over_a_short_loss_is_one_and_one_back_is_another():
    assert len(texts([(0, 24.0), (5, None), (10, 27.0), (15, 24.0), (20, 24.0)])) == 2
