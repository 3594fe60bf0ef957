"""The guard's rules about the mains, by what a UPS tells.

On battery the stand is held, safe, and goes on by itself once mains has been back for a while; the run's own table
then brings the set-up about again. Before the battery is empty the run ends. A UPS that is silent is a warning: whether
there is mains is then unknown, and what is unknown begins no hold. It ends none either.
"""

from __future__ import annotations

import math

from thermostand.drivers.devices.ups import CHARGE, LOW_BATTERY, ON_BATTERY, RUNTIME, UpsSettings
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import guard_rule
from thermostand.foundation.instants import format_duration
from thermostand.stand.safety.fault import Fault, Readings, Rule, Watch, get_value

MAINS_LOST = guard_rule("mains_lost", "the stand is on battery, or mains is back for too short a time")
BATTERY_LOW = guard_rule(
    "battery_low",
    "the battery is nearly empty, and the run ends before it is",
    "see to the mains; then `stand reset`, and `stand resume` continues the run",
)
UPS_SILENT = guard_rule(
    "ups_silent",
    "the UPS does not tell whether there is mains",
    "see to upsd and its driver (`upsc UPS@HOST`); a loss of mains is not noticed meanwhile",
)
# Round number; nothing was measured. upsd calls its own data stale after 15 s (MAXAGE), and its driver may restart.
_SILENT_POLLS, _SILENT_S = 3, 60.0


def watch_mains(name: str, settings: UpsSettings) -> tuple[Watch, ...]:
    """The rules for one UPS: hold, end, warn."""
    silent_s = max(_SILENT_S, _SILENT_POLLS * settings.poll_s)
    return (
        Watch(end_before_battery(name, settings)),
        Watch(require_mains(name, settings), action="hold", ends_itself=True),
        Watch(require_answer(name), silent_s, "warn"),
    )


def require_mains(name: str, settings: UpsSettings) -> Rule:
    """On battery for hold_after_s, until mains has been back for back_after_s, as the last answer says: silence neither
    begins nor ends a hold."""
    lost_ns: int | None = None  # since when it is on battery, as far as is known
    back_ns: int | None = None  # since when mains is back after a loss that counted
    is_lost = False

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        nonlocal lost_ns, back_ns, is_lost
        reading = readings.known(f"{name}.{ON_BATTERY.name}")
        on_battery, answered_ns = (math.nan, now_ns) if reading is None else (reading.value, reading.time_ns)
        if on_battery == 1:
            lost_ns, back_ns = now_ns if lost_ns is None else lost_ns, None
            is_lost = is_lost or now_ns - lost_ns >= to_ns(settings.hold_after_s)
        elif on_battery == 0:
            lost_ns = None
            back_ns = now_ns if is_lost and back_ns is None else back_ns
        if not is_lost:
            return None
        if back_ns is None:
            return Fault(MAINS_LOST, f"{name} is on battery: the mains has failed")
        if on_battery != 0 or answered_ns - back_ns < to_ns(settings.back_after_s):
            waited = format_duration(to_ns(settings.back_after_s))
            return Fault(MAINS_LOST, f"mains is back at {name}, and is waited for to last for {waited}")
        is_lost, back_ns = False, None
        return None

    return rule


def end_before_battery(name: str, settings: UpsSettings) -> Rule:
    """On battery, and its charge, or the time left for it, is below its limit, or it says itself that it is low. The
    time left goes on while the UPS is silent. The camera, too, is then switched off."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        if get_value(readings, f"{name}.{ON_BATTERY.name}") != 1:
            is_forced = get_value(readings, f"{name}.{LOW_BATTERY.name}") == 1 and _is_ordered(readings, name)
            return Fault(BATTERY_LOW, f"{name}: its shutdown is ordered", cuts_camera=True) if is_forced else None
        charge_percent, left_s = get_value(readings, f"{name}.{CHARGE.name}"), _left_s(readings, name, now_ns)
        if get_value(readings, f"{name}.{LOW_BATTERY.name}") == 1:
            why = "it says that its battery is low"
        elif charge_percent < settings.end_below_percent:
            why = f"its charge is {charge_percent:.0f} %, limit {settings.end_below_percent:g} %"
        elif left_s < settings.end_below_s:
            why = f"it lasts for {max(left_s, 0.0):.0f} s more, limit {settings.end_below_s:g} s"
        else:
            return None
        return Fault(BATTERY_LOW, f"{name} is on battery, and {why}", cuts_camera=True)

    return rule


def require_answer(name: str) -> Rule:
    """It tells now whether there is mains."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.latest(f"{name}.{ON_BATTERY.name}")
        if reading is None:
            return Fault(UPS_SILENT, f"{name} was never read")
        return Fault(UPS_SILENT, reading.reason) if math.isnan(reading.value) else None

    return rule


def _is_ordered(readings: Readings, name: str) -> bool:
    """Whether a primary upsmon has ordered the shutdown, which cuts the output also when mains is back."""
    reading = readings.known(f"{name}.{LOW_BATTERY.name}")
    return reading is not None and "FSD" in reading.reason.split()


def _left_s(readings: Readings, name: str, now_ns: int) -> float:
    reading = readings.known(f"{name}.{RUNTIME.name}")
    return math.nan if reading is None else reading.value - (now_ns - reading.time_ns) / NS_PER_S
