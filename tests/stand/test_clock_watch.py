from tests.host import Host
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import CLOCK_STEP, HOST_SUSPENDED
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.recording.format.utc_offsets import UtcOffsets, collect_offsets
from thermostand.stand.running.opening.clock_watch import ClockWatch


class Watched:
    """A watch that looks once a second of a host."""

    def __init__(self, recorded_s: float = 0.0, no_earlier_than_ns: int = 0):
        self.host, self.hub, self.events = Host(), Hub(), list[Event]()
        self.clock = self.host.clock(no_earlier_than_ns)
        self.hub.subscribe(self._keep)
        self._watch = ClockWatch(self.hub, self.clock, to_ns(recorded_s))
        self._watch.look()

    def _keep(self, item: Item) -> None:
        assert isinstance(item, Event)
        self.events.append(item)

    def passes(self, duration_s: int) -> None:
        for _ in range(duration_s):
            self.host.awake_ns += NS_PER_S
            self._watch.look()

    def reported(self) -> list[tuple[str, object, object]]:
        return [(e.level, e.data["offset_before_ns"], e.data["offset_after_ns"]) for e in self.events]


def test_a_system_clock_that_goes_along_is_never_an_event():
    watched = Watched()
    watched.passes(3000)
    watched.host.step(0.9)
    watched.passes(3000)
    assert watched.events == []


def test_a_step_is_recorded_with_both_offsets_and_both_instants():
    watched = Watched()
    watched.passes(10)
    begin_ns = watched.clock.now_ns()
    watched.host.step(3600)
    watched.passes(2)
    (event,) = watched.events
    assert (event.level, event.kind, event.time_ns) == ("warning", CLOCK_STEP, begin_ns + NS_PER_S)
    assert event.data == {
        "offset_before_ns": 0,
        "offset_after_ns": to_ns(3600),
        "seen_ns": begin_ns,
        "stand_ns": begin_ns + NS_PER_S,
        "utc_ns": begin_ns + NS_PER_S + to_ns(3600),
    }
    assert event.text.count("+3600.000 s") == 2
    watched.host.step(-3600)
    watched.passes(2)
    assert watched.reported()[1:] == [("warning", to_ns(3600), 0)]


def test_slow_drift_is_recorded_each_time_it_has_come_to_more_than_a_second():
    watched = Watched()
    for _ in range(5000):
        watched.host.step(500e-6)  # as fast as NTP slews
        watched.passes(1)
    warnings = [each for each in watched.reported() if each[0] == "warning"]
    assert warnings == [("warning", to_ns(1.0005) * n, to_ns(1.0005) * (n + 1)) for n in range(2)]


def test_an_offset_is_repeated_so_that_each_segment_knows_it():
    watched = Watched()
    watched.host.step(-5)
    watched.passes(650)
    assert watched.reported() == [("warning", 0, to_ns(-5))] + [("info", to_ns(-5), to_ns(-5))] * 2


def test_a_run_that_goes_on_records_at_once_what_differs_from_the_session():
    assert Watched().events == []
    assert Watched(recorded_s=3600).reported() == [("warning", to_ns(3600), 0)]
    ahead = Watched(no_earlier_than_ns=Host().utc_ns() + to_ns(7200))
    assert ahead.reported() == [("warning", 0, to_ns(-7200))]
    still = Watched(-7200, Host().utc_ns() + to_ns(7200))
    assert still.reported() == [("info", to_ns(-7200), to_ns(-7200))]


def test_a_suspend_is_an_event_with_its_length_and_no_step():
    watched = Watched()
    watched.passes(5)
    begin_ns = watched.clock.now_ns()
    watched.host.suspended_ns += to_ns(40)
    watched.passes(2)
    (event,) = watched.events
    assert (event.level, event.kind) == ("warning", HOST_SUSPENDED)
    assert event.data == {"length_s": 40.0, "seen_ns": begin_ns, "stand_ns": begin_ns + to_ns(41)}
    assert "suspended for 40.0 s" in event.text


def step_event(time_s: float, before_s: float, after_s: float) -> Event:
    data = {"offset_before_ns": to_ns(before_s), "offset_after_ns": to_ns(after_s)}
    return Event(to_ns(time_s), "warning", CLOCK_STEP, "", data)


def test_the_offset_that_held_at_an_instant_makes_it_utc():
    utc = collect_offsets([step_event(200, 3600, -10), step_event(100, 5, 3600), Event(150, "info", "other", "")])
    reported = [(time_s, utc.at(to_ns(time_s)) // NS_PER_S) for time_s in (0, 99.9, 100, 199.9, 200, 1e6)]
    assert reported == [(0, 5), (99.9, 5), (100, 3600), (199.9, 3600), (200, -10), (1e6, -10)]
    assert utc.date_time(to_ns(100)) == "1970-01-01 01:01:40"
    assert utc.utc_text(to_ns(99)) == "1970-01-01T00:01:44.000000000Z"
    assert UtcOffsets().utc_ns(77) == 77


def test_utc_finds_the_first_instant_that_had_it_or_the_step_over_it():
    utc = collect_offsets([step_event(100, 0, 3600), step_event(200, 3600, -10)])
    for utc_s, stand_s in [(50, 50), (99, 99), (100, 100), (3000, 100), (3750, 150), (3801, 3811), (190, 100)]:
        assert utc.stand_ns(to_ns(utc_s)) == to_ns(stand_s)


def test_what_cannot_be_understood_says_nothing_and_no_offset_leaves_what_an_instant_can_be():
    odd = Event(5, "warning", CLOCK_STEP, "", {"offset_before_ns": "x", "offset_after_ns": 7})
    assert collect_offsets([odd, Event(6, "warning", CLOCK_STEP, "")]) == UtcOffsets()
    far = collect_offsets([Event(5, "warning", CLOCK_STEP, "", {"offset_before_ns": 0, "offset_after_ns": 10**30})])
    assert far.date_time(5).startswith("2262-")
