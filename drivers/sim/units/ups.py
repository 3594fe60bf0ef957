"""A UPS behind the upsd of Network UPS Tools, as its clients see it on the wire.

Source: RFC 9271, and docs/net-protocol.txt of NUT 2.8. Its battery lasts for half an hour, and is charged in two.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from thermostand.drivers.sim.fakes import ADDED, Bench, fake

_LASTS_S, _CHARGES_S = 1800.0, 7200.0
_LOW_PERCENT = 20.0


class FakeUps:
    """mains_failed: it is on battery. Faults: status (shown instead of the true one), stale (upsd has no fresh data),
    driver_gone, untold (variables that this UPS does not have). logins counts the clients that it feeds."""

    def __init__(self, name: str, users: Mapping[str, str]) -> None:
        self.name = name
        self.users = dict(users)
        self.charge_percent = 100.0
        self.status: str | None = None
        self.mains_failed = self.stale = self.driver_gone = False
        self.untold: set[str] = set()
        self.logins = 0

    def advance(self, time_ns: int, dt_s: float) -> None:
        """The battery empties, or is charged."""
        change = -dt_s / _LASTS_S if self.mains_failed else dt_s / _CHARGES_S
        self.charge_percent = min(100.0, max(0.0, self.charge_percent + 100.0 * change))

    def set_charge(self, percent: float) -> None:
        """The battery has so much left."""
        self.charge_percent = percent

    def variables(self) -> dict[str, str]:
        """What upsd has of it."""
        words = ["OB", "DISCHRG"] if self.mains_failed else ["OL"] + ["CHRG"] * (self.charge_percent < 100.0)
        words += ["LB"] * (self.charge_percent < _LOW_PERCENT)
        found = {
            "ups.status": " ".join(words) if self.status is None else self.status,
            "battery.charge": f"{self.charge_percent:.0f}",
            "battery.runtime": f"{_LASTS_S * self.charge_percent / 100.0:.0f}",
            "device.mfr": 'Simulated "UPS"',
            "device.model": "S 1500",
            "device.serial": "U-1",
        }
        return {name: value for name, value in found.items() if name not in self.untold}


class UpsdEngine:
    """One client of upsd: requests in, lines out."""

    def __init__(self, ups: FakeUps) -> None:
        self._ups = ups
        self._pending = ""
        self._user = self._password = ""

    def feed(self, data: bytes) -> bytes:
        """The answers to the lines that are whole."""
        *lines, self._pending = (self._pending + data.decode("latin-1")).split("\n")
        return "".join(f"{self._answer(line.split())}\n" for line in lines).encode("latin-1")

    def _answer(self, words: list[str]) -> str:
        ups = self._ups
        match words:
            case ["LIST", "UPS"]:
                return f'BEGIN LIST UPS\nUPS {ups.name} "simulated"\nEND LIST UPS'
            case ["GET", "VAR", name, variable] if name == ups.name:
                return self._tell(variable)
            case ["GET", "VAR", _, _]:
                return "ERR UNKNOWN-UPS"
            case ["USERNAME", user]:
                self._user = user
                return "OK"
            case ["PASSWORD", password]:
                self._password = password
                return "OK"
            case ["LOGIN", name]:
                if name != ups.name:
                    return "ERR UNKNOWN-UPS"
                if ups.users.get(self._user) != self._password:
                    return "ERR ACCESS-DENIED"
                ups.logins += 1
                return "OK"
            case ["LOGOUT"]:
                return "OK Goodbye"
            case _:
                return "ERR UNKNOWN-COMMAND"

    def _tell(self, variable: str) -> str:
        if self._ups.driver_gone:
            return "ERR DRIVER-NOT-CONNECTED"
        if self._ups.stale:
            return "ERR DATA-STALE"
        value = self._ups.variables().get(variable)
        if value is None:
            return "ERR VAR-NOT-SUPPORTED"
        quoted = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'VAR {self._ups.name} {variable} "{quoted}"'


@fake("ups", rank=ADDED)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeUps:
    ups = FakeUps(settings["ups"] or "ups", {"thermostand": "simulated"})
    bench.plant.on_step.append(ups.advance)
    bench.listen(name, settings["address"], lambda: UpsdEngine(ups))
    return ups
