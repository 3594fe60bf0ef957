"""What people do to a stand over its doors, HTTP and the bus, and what they are answered (doors-N.jsonl)."""

from __future__ import annotations

import http.client
import json
import re
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.torture.case import Case, Order
from thermostand.foundation.errors import StandError
from thermostand.stand.serving.client import Server

_DOOR_S = 20.0  # of the host


class OperatorActions:
    """server: finds who answers, or raises SessionError. bus: its address. session: the run's name, "" before."""

    def __init__(
        self, case: Case, path: Path, server: Callable[[], Server], bus: Callable[[], str], session: Callable[[], str]
    ) -> None:
        self._case, self._server, self._bus, self._session = case, server, bus, session
        self._rows = path.open("w", buffering=1)

    def give(self, order: Order, now_ns: int) -> object:
        """Do what the order says, write down what came of it, and return that."""
        answer = self._given(order)
        self.note(order, now_ns, answer)
        return answer

    def note(self, order: Order, now_ns: int, answer: object) -> None:
        """Write down what was done some other way."""
        row = {"time_ns": now_ns, "verb": order.verb, "body": order.body, "answer": answer}
        with suppress(ValueError):  # closed: a late answer
            self._rows.write(f"{json.dumps(row)}\n")

    def close(self) -> None:
        """No more is written down."""
        self._rows.close()

    def asked(self, method: str, path: str, body: dict[str, object] | None = None) -> object:
        """The answer, or the sentence of a refusal."""
        try:
            return self._server().request(method, f"/api/v1/{path}", body, _DOOR_S)
        except (StandError, OSError, http.client.HTTPException) as error:
            return {"refused": str(error)}

    def _given(self, order: Order) -> object:
        match order.verb:
            case "switch_on" | "switch_off":
                return self._second_master(order)
            case "state":
                state = self.asked("GET", "state")
                if self._case.attended and isinstance(state, dict) and state.get("prompt"):
                    self.asked("POST", "run/continue", {})
                return state
            case "skip" | "extend":
                plan = self.asked("GET", "plan")
                steps = plan if isinstance(plan, list) else []
                under_way = next((each["step_id"] for each in steps if each.get("standing") == "under_way"), "none")
                by: dict[str, object] = {"by_s": 60.0} if order.verb == "extend" else {}
                return self.asked("POST", f"run/{order.verb}", {**by, "step_id": under_way})
            case "note":
                body = {"text": "a note", "tags": ["torture"]}
                return self.asked("POST", f"sessions/{self._session() or 'none'}/notes", body)
            case _:
                return self.asked("POST", f"run/{order.verb}", {})

    def _second_master(self, order: Order) -> object:
        """Another program on the bus writes a coil of the relay board, for good."""
        found = re.fullmatch(r"tcp:(.+):(\d+)", self._bus())
        if found is None:
            return None
        value = 0xFF00 if order.verb == "switch_on" else 0
        frame = struct.pack(">HHHBBHH", 7, 0, 6, 2, 5, int(order.body.get("relay", 0)), value)
        with suppress(OSError), socket.create_connection((found[1], int(found[2])), 1.0) as wire:
            wire.settimeout(1.0)
            wire.sendall(frame)
            return wire.recv(64).hex()
        return None
