"""The lamp in the simulated laboratory: it answers at the address of the stand's file."""

from typing import Any

from thermostand.drivers.sim.wire import LineEngine


class FakeLamp:
    """Its state is how much light it gives, %."""

    def __init__(self, bench: Any, name: str, settings: Any) -> None:
        self.percent = 0.0
        bench.listen(name, settings["address"], lambda: LineEngine(self.answer))

    def answer(self, line: bytes) -> bytes:
        """Return what it sends for a line."""
        if line.strip() != b"?":
            self.percent = float(line)
        return b"I=%.2f" % (self.percent / 100)
