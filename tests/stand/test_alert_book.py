"""What is sent of a session's events: each cause once, when it has lasted, and once more when it is over."""

import pytest

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import make_alert
from thermostand.foundation.items import Event
from thermostand.stand.serving.alerts import AlertTracker

CAUSES = (
    "trip", "hold", "device_lost", "disk", "prompt", "run_started", "run_finished", "run_aborted", "queue_empty",
    "eta_slipped",
)  # fmt: skip


def event(kind, at_s=0.0, level="warning", text="why", **data):
    return Event(round(at_s * NS_PER_S), level, kind, text, data)


def book(**changes):
    return AlertTracker(**{"name": "lab", "causes": CAUSES, "grace_ns": 60 * NS_PER_S, "most_per_h": 20, **changes})


def reported(found, *events, until_s=0):
    """(title, text) of all messages of these events, and of those that are due second by second up to then."""
    messages = []
    for each in events:
        messages += found.due(each.time_ns) + found.receive(each, each.time_ns)
    last_s = max((each.time_ns for each in events), default=0) // NS_PER_S
    for second in range(last_s, until_s + 1):
        messages += found.due(second * NS_PER_S)
    return [(message.title.removeprefix("lab: "), message.text) for message in messages]


@pytest.mark.parametrize(
    ("kind", "data", "cause", "phase"),
    [
        ("guard.over_temperature", {"action": "abort"}, "trip", "raised"),
        ("guard.sensor_stale", {"action": "hold"}, "hold", "lasting"),
        ("guard.sensors_disagree", {"action": "warn"}, None, None),
        ("released", {"reason": "interlock"}, "hold", "over"),
        ("released", {"reason": "operator"}, None, None),
        ("hold_ended", {}, "hold", "over"),
        ("device_lost", {"device": "regulator"}, "device_lost", "lasting"),
        ("device_back", {"device": "regulator"}, "device_lost", "over"),
        ("frames_stopped", {}, "disk", "lasting"),
        ("disk_nearly_full", {}, "disk", "raised"),
        ("prompt", {"attended": True}, "prompt", "raised"),
        ("run.start", {}, "run_started", "raised"),
        ("run.end", {"status": "complete"}, "run_finished", "raised"),
        ("run.end", {"status": "tripped"}, "run_aborted", "raised"),
        ("queue_empty", {}, "queue_empty", "raised"),
        ("eta_slipped", {}, "eta_slipped", "raised"),
        ("home_residual", {}, None, None),
    ],
)
def test_what_an_event_means(kind, data, cause, phase):
    sign = make_alert(event(kind, **data))
    assert (cause, phase) == (None, None) if sign is None else (sign.cause, sign.phase) == (cause, phase)


def test_a_prompt_without_an_operator_is_not_reported():
    assert make_alert(event("prompt", level="info", attended=False)) is None


def test_what_is_over_within_the_grace_time_is_not_reported():
    found = book()
    assert (
        reported(found, event("device_lost", 0, device="flap"), event("device_back", 59, device="flap"), until_s=300)
        == []
    )


def test_what_lasts_is_reported_once_and_when_it_is_over():
    found = book()
    lost = [event("device_lost", second, device="flap") for second in (0, 70, 80)]
    assert reported(found, *lost, until_s=200) == [("a device is lost", "why")]
    assert not found.is_well
    assert reported(found, event("device_back", 300, text="answers", device="flap")) == [
        ("ok again", "answers (it was: why)")
    ]
    assert found.is_well
    assert reported(found, event("device_lost", 400, device="flap"), until_s=500) == [("a device is lost", "why")]


def test_two_devices_are_two_causes():
    found = book(grace_ns=0)
    assert (
        len(reported(found, event("device_lost", 0, device="a"), event("device_lost", 0, device="b"), until_s=1)) == 2
    )


def test_a_trip_and_the_end_it_makes_are_reported_at_once():
    found = book()
    trip = event("guard.over_temperature", 1, "error", "air is hot", action="abort")
    end = event("run.end", 2, "error", "aborted: air is hot", status="tripped")
    tripped, (_, ended) = reported(found, trip, trip, end, until_s=300)
    assert (tripped, ended) == (("TRIPPED", "air is hot"), "aborted: air is hot")


def test_a_hold_that_an_operator_cleared_is_over():
    found = book()
    hold = event("guard.device_fault", 0, "error", "set-point changed", action="hold")
    assert reported(found, hold, until_s=60) == [("held", "set-point changed")]
    assert [title for title, _ in reported(found, event("released", 90, reason="interlock"))] == ["ok again"]


def test_a_run_that_fails_before_it_begins_is_reported_and_one_that_ended_not_twice():
    found = book()
    assert len(reported(found, event("run_failed", 0))) == 1
    assert len(reported(found, event("run.end", 1, status="failed"), event("run_failed", 1))) == 1
    assert len(reported(found, event("run_failed", 2, run=7))) == 1  # the next one of a queue


def test_in_an_hour_only_so_many_are_sent_but_every_trip():
    found = book(most_per_h=3, grace_ns=0)
    prompts = [event("prompt", second, text=str(second), attended=True) for second in range(10)]
    assert [text for _, text in reported(found, *prompts)] == ["0", "1", "2"]
    trip = event("guard.over_temperature", 20, action="abort")
    ((title, text),) = reported(found, trip)
    assert (title, text[:11]) == ("TRIPPED", "why\n7 messa")
    assert [text for _, text in reported(found, event("prompt", 3700, text="later", attended=True))] == ["later"]


def test_only_what_is_wanted_is_reported():
    found = book(causes=("trip",))
    assert reported(found, event("run.start", 0), event("guard.x", 1, action="abort")) == [("TRIPPED", "why")]
