"""What can be broken of a stage."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from drivers.sim.laboratory import Laboratory
from drivers.sim.laboratory_fault import Fault, number, number_or_none
from drivers.sim.motion.ximc import FakeAxis
from drivers.sim.motion.ximc_table import FLAG_DRIVER_OVERHEAT, FLAG_WINDING_MISMATCH

AXES = ("linear", "rotary")


def axis_faults() -> Iterator[tuple[str, Fault]]:
    """Every axis has the same."""

    def cycle(axis: FakeAxis, value: object) -> None:
        if value:
            axis.power_cycle()

    def to(attribute: str, kind: Callable[[object], object]) -> Callable[[FakeAxis, object], None]:
        return lambda axis, value: setattr(axis, attribute, kind(value))

    def danger(bits: int) -> Callable[[FakeAxis, object], None]:
        return lambda axis, value: setattr(axis, "danger", axis.danger & ~bits | (bits if value else 0))

    faults: dict[str, tuple[Callable[[FakeAxis, object], None], object, object, str]] = {
        "limit_hit": (
            to("limit", lambda side: str(side or "")),
            "right",
            "",
            "left or right: this switch reads closed",
        ),
        "wrong_limit": (to("wrong_limit", bool), True, False, "a stop at a switch is taken for the other one's"),
        "lost_steps": (to("lost_steps", number), 200, 0, "steps by which the mechanics fall back, the count does not"),
        "jam_steps": (to("stall_steps", number_or_none), 0, None, "steps beyond which the mechanics do not go"),
        "ctp_error": (to("ctp_error", bool), True, False, "encoder and count differ"),
        "overheated": (danger(FLAG_DRIVER_OVERHEAT), True, False, "the motor's driver is too warm"),
        "winding": (danger(FLAG_WINDING_MISMATCH), True, False, "the windings differ"),
        "endless": (to("endless", bool), True, False, "a move does not end"),
        "motor_off": (to("motor_off", bool), True, False, "no current; the next move brings it back"),
        "restart": (cycle, True, False, "off and on again: not homed, position 0"),
    }
    for name in AXES:
        for kind, (act, worst, mended, text) in faults.items():

            def apply(
                laboratory: Laboratory,
                value: object,
                name: str = name,
                act: Callable[[FakeAxis, object], None] = act,
            ) -> None:
                act(laboratory.axis(name), value)

            yield f"{name}.{kind}", Fault(apply, worst, mended, text)
