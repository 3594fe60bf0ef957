"""The end of a run that moves is reported, each time by another tenth of the whole."""

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import ETA_SLIPPED
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.stand.running.status import EtaSlip


class Slip:
    """A run of ten hours whose end is set by the test."""

    def __init__(self):
        self.now_s, self.end_s, self.hub, self.reported = 0, 36_000, Hub(), []
        self.hub.subscribe(lambda item: self.reported.append(item) if item.kind == ETA_SLIPPED else None)
        self.hub.subscribe(EtaSlip(self.hub, self, lambda _: self.end_s - self.now_s, lambda: 0))

    def now_ns(self):
        return self.now_s * NS_PER_S

    def mark(self):
        self.hub.publish(StepMark(self.now_ns(), "a", 0, "soak", StepState.DONE))


def test_each_tenth_is_reported_once():
    slip = Slip()
    for end_s in (36_000, 38_000, 39_600, 39_700, 43_100, 43_200, 40_000):
        slip.now_s += 60
        slip.end_s = end_s
        slip.mark()
        slip.mark()
    assert [item.data["later_s"] for item in slip.reported] == [3600.0, 3600.0]
    assert slip.reported[0].text.startswith("the run ends 60 min later")
    assert slip.reported[0].level == "info"


def test_a_hold_that_ends_and_a_changed_plan_are_looked_at_and_nothing_else():
    slip = Slip()
    slip.end_s = 45_000
    slip.hub.publish(Event(0, "info", "note", "windy"))
    assert slip.reported == []
    slip.hub.publish(Event(0, "info", "released", "disk_low", {"reason": "disk_low"}))
    assert len(slip.reported) == 1
