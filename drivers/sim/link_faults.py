"""The faults that every byte link has: names, worst values, and how each is set on its wire."""

from __future__ import annotations

from dataclasses import dataclass

from thermostand.drivers.sim.faults import LinkFaults
from thermostand.drivers.sim.wire import PtyWire, TcpWire

_MIXED = ("drop", "flip", "cut", "junk", "late")

# Kind -> worst value, the one that mends it, meaning.
LINK_FAULTS: dict[str, tuple[object, object, str]] = {
    "silent": (True, False, "no reply leaves"),
    "drop": (0.05, 0.0, "share of replies lost"),
    "flip": (0.05, 0.0, "share of replies with one bit flipped"),
    "cut": (0.05, 0.0, "share of replies of which only the first half comes"),
    "junk": (0.05, 0.0, "share of replies with 7 random bytes before them"),
    "late": (0.05, 0.0, "share of replies that come 0.5 s late"),
    "mixed": (0.05, 0.0, "share of replies that are dropped, flipped, cut, late or have junk before them"),
    "delay_s": (0.2, 0.0, "every reply is slow by so many real seconds"),
    "late_s": (1.0, 0.0, "the next reply is late by so many real seconds"),
    "garbled": (3, 0, "so many of the coming replies lose their second half"),
    "echo": (True, False, "the request comes back before the reply"),
    "byte_by_byte": (True, False, "one write a byte"),
    "flow_control": (True, False, "XOFF and XON come among the replies"),
    "hangs_up": (True, False, "over TCP: each connection is closed after one reply"),
    "swallows_first": (True, False, "over TCP: the first request over each connection is lost"),
    "unplugged": (True, False, "connections are cut, and nobody listens; plugged in again by another port"),
}


@dataclass(frozen=True, slots=True)
class Link:
    """One wire and what breaks its replies."""

    wire: PtyWire | TcpWire
    faults: LinkFaults


def set_link_fault(link: Link, kind: str, value: object) -> None:
    """One of LINK_FAULTS; must not be called under a lock that the wire's thread may want."""
    match kind:
        case "unplugged":
            if value:
                link.wire.unplug()
            else:
                link.wire.plug()
        case "mixed":
            for each in _MIXED:
                setattr(link.faults, each, float(str(value or 0)) / len(_MIXED))
        case "silent" | "echo" | "byte_by_byte" | "flow_control" | "hangs_up" | "swallows_first":
            setattr(link.faults, kind, bool(value))
        case "garbled":
            link.faults.garbled = int(str(value or 0))
        case _:
            setattr(link.faults, kind, float(str(value or 0)))
