"""The simulator's control socket: time, truth and faults. One JSON object a line in, one out.

    {"do": "advance", "now_ns": N}              -> {"now_ns": N}       virtual time moves to N
    {"do": "settle"}                            -> {}                  all that has arrived on the wires is answered
    {"do": "state"}                             -> {"now_ns": N, "air_degC": ...}   the plant's true state
    {"do": "optics"}                            -> {"centres_px": [[x, y], ...]}   noise-free marker centres
    {"do": "fault", "name": S, "value": V}      -> {"name": S}         one of drivers.sim.laboratory_faults.FAULTS
    {"do": "faults"}                            -> {"faults": [{"name": S, "worst": V, ...}], "standing": {S: V}}
    {"do": "break", "name": S, "value": V, "for_s": N or null}  -> {"name": S}    as one that was planned
    {"do": "mend", "name": S}                   -> {"name": S}
    {"do": "unplayed"}                          -> {"camera": [S, ...]}    features of its GenICam file that do not work
    {"do": "quit"}                              -> {}                  the laboratory ends

Anything wrong is answered with {"error": sentence}.
"""

from __future__ import annotations

import json
from collections.abc import Callable

from thermostand.drivers.sim.laboratory import Laboratory
from thermostand.drivers.sim.laboratory_faults import FaultSchedule, inject, make_table
from thermostand.drivers.sim.wire import LineEngine, LinkFaults, TcpWire
from thermostand.foundation.addresses import parse_tcp_address
from thermostand.foundation.errors import ConfigError


class Control:
    """Answers control requests for one laboratory."""

    def __init__(self, laboratory: Laboratory, schedule: FaultSchedule, quit_: Callable[[], None]) -> None:
        self._laboratory = laboratory
        self._schedule = schedule
        self._quit = quit_

    def answer(self, line: bytes) -> bytes:
        """The answer to one request line."""
        return json.dumps(self._result(line)).encode()

    def _result(self, line: bytes) -> dict[str, object]:
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise ValueError(f"expected an object, got {line[:80]!r}")
            return self._perform({str(key): value for key, value in request.items()})
        except ConfigError as error:
            return {"error": str(error)}
        except (ValueError, KeyError, TypeError) as error:
            return {"error": f"{type(error).__name__}: {error}"}

    def _perform(self, request: dict[str, object]) -> dict[str, object]:
        match request:
            case {"do": "advance", "now_ns": int(now_ns)}:
                self._schedule.advance(now_ns)
                return {"now_ns": now_ns}
            case {"do": "settle"}:
                self._laboratory.settle()
                return {}
            case {"do": "state"}:
                return dict(self._laboratory.state())
            case {"do": "unplayed"}:
                return {name: camera.unplayed for name, camera in self._laboratory.cameras.items()}
            case {"do": "quit"}:
                self._quit()
                return {}
            case {"do": "optics"}:
                return {"centres_px": self._laboratory.compute_true_centres_px()}
            case {"do": "faults"}:
                return {"faults": make_table(self._schedule.known), "standing": self._schedule.list_standing()}
            case {"do": "break", "name": str(name), "value": value, "for_s": int() | float() | None as for_s}:
                self._schedule.break_now(name, value, for_s)
                return {"name": name}
            case {"do": "mend", "name": str(name)}:
                self._schedule.mend(name)
                return {"name": name}
            case {"do": "fault", "name": str(name), "value": value}:
                if name not in self._schedule.known:
                    raise ValueError(f"no fault {name!r}; there are {', '.join(sorted(self._schedule.known))}")
                inject(self._laboratory, name, value)
                return {"name": name}
            case _:
                raise ValueError(f"cannot understand {request}")


def serve_control(laboratory: Laboratory, schedule: FaultSchedule, quit_: Callable[[], None]) -> TcpWire:
    """Listen on the laboratory's control address; `quit_` is called for a `quit` request."""
    control = Control(laboratory, schedule, quit_)
    place = parse_tcp_address(laboratory.spec.control, may_be_free=True)
    return TcpWire(*place, lambda: LineEngine(control.answer), LinkFaults())
