"""A host whose clocks a test moves."""

from thermostand.foundation.clock import WallClock, to_ns


class Host:
    """The clocks of a host that can be suspended, and whose system clock can be stepped."""

    def __init__(self, utc_ns: int = to_ns(1_800_000_000)):
        self.awake_ns, self.suspended_ns = to_ns(1000), 0
        self._utc_minus_boot_ns = utc_ns - self.awake_ns

    def clock(self, no_earlier_than_ns: int = 0) -> WallClock:
        return WallClock(no_earlier_than_ns, self.boot_ns, self.utc_ns, lambda: self.awake_ns)

    def boot_ns(self) -> int:
        return self.awake_ns + self.suspended_ns

    def utc_ns(self) -> int:
        return self.boot_ns() + self._utc_minus_boot_ns

    def step(self, by_s: float) -> None:
        self._utc_minus_boot_ns += to_ns(by_s)
