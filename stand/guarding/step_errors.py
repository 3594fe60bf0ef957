"""Device errors that a step has met: one table of (kind of device, error) says which rule of the guard each is.

A step may meet a fault before the rule that would find it does. It is then held for at once, as that rule would; what
the table of rules (rules.py) aborts for, such as a thermometer that stays silent, it aborts for meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from thermostand.foundation.errors import DeviceAlarm, DeviceError, GarbledReply, Unreachable
from thermostand.foundation.events import guard_rule
from thermostand.foundation.items import Batch, Item
from thermostand.foundation.readings import Quality
from thermostand.stand.guarding.interlocks import (
    DEVICE_FAULT,
    STAGE_ALARM,
)
from thermostand.stand.safety.fault import Fault, Readings, Watch

DEVICE_LOST = guard_rule("device_lost", "a step met a device that does not answer")


@dataclass(frozen=True, slots=True)
class _ErrorRule:
    """kind: of device (stand.assembly.device_kinds), "" for any. ends_itself: when the device is read again; else an
    operator has to reset it."""

    kind: str
    error: type[DeviceError]
    rule: str
    ends_itself: bool = False


_CAMERA = "camera"
# The first that fits. A wire that is back needs no operator; whatever a device itself says, or refuses, does.
_ROWS = (
    _ErrorRule("axis", DeviceAlarm, STAGE_ALARM),
    # A step has waited for it (stand/imaging) before it gave up, and it may be without supply: nobody reads it then.
    _ErrorRule(_CAMERA, Unreachable, DEVICE_LOST),
    _ErrorRule("", Unreachable, DEVICE_LOST, ends_itself=True),
    _ErrorRule("", GarbledReply, DEVICE_LOST, ends_itself=True),
    _ErrorRule("", DeviceError, DEVICE_FAULT),
)
_UNREAD = _ErrorRule("", DeviceError, DEVICE_LOST)  # of what is never polled: nothing would show that it is back


class StepErrors:
    """The device errors that steps have met and that count still. A subscriber of the hub. kinds: of the devices, by
    name."""

    def __init__(self, kinds: Mapping[str, str]) -> None:
        self._kinds = kinds
        self._standing: dict[_ErrorRule, tuple[str, DeviceError]] = {}

    @property
    def watches(self) -> tuple[Watch, ...]:
        """One for each row: it objects as long as an error of that row counts."""
        return tuple(
            Watch(partial(self._find_objection, row), action="hold", ends_itself=row.ends_itself)
            for row in (*_ROWS, _UNREAD)
        )

    def note(self, error: DeviceError) -> None:
        """A step has met it just now."""
        name = error.device.partition(".")[0]
        kind = self._kinds.get(name)
        fits = (row for row in _ROWS if row.kind in ("", kind) and isinstance(error, row.error))
        self._standing[_UNREAD if kind is None else next(fits)] = (name, error)

    def clear_answered(self) -> None:
        """An operator has looked: only what has not answered since counts still."""
        self._standing = {row: met for row, met in self._standing.items() if row.ends_itself}

    def __call__(self, item: Item) -> None:
        """A device that gives readings again is back."""
        if isinstance(item, Batch) and any(reading.quality is not Quality.BAD for reading in item.readings):
            self._standing = {
                row: met for row, met in self._standing.items() if not (row.ends_itself and met[0] == item.device)
            }

    def _find_objection(self, row: _ErrorRule, readings: Readings, now_ns: int) -> Fault | None:
        met = self._standing.get(row)
        return None if met is None else Fault(row.rule, str(met[1]))
