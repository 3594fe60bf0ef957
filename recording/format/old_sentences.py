"""Events of sessions recorded before events had data: what their sentences say, as the data they would have today.

The one place where a sentence is read. Nothing that is recorded now depends on it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

_RESTARTED = re.compile(r"^capture (\S+) begins anew")
_BLOCKS = re.compile(r"\bblocks? (\d{1,18}(?: to \d{1,18})?(?:, \d{1,18}(?: to \d{1,18})?)*)")
_HOME = re.compile(r"(?P<axis>\S+): home was at (?P<residual>-?\d+(\.\d+)?(e-?\d+)?) (?P<unit>mm|deg)\b")


def data_of_sentence(kind: str, text: str) -> dict[str, object]:
    """The data of an event that was recorded without any; empty when its sentence says nothing that is needed."""
    read = _READERS.get(kind)
    return {} if read is None else read(text)


def _restarted(text: str) -> dict[str, object]:
    match = _RESTARTED.match(text)
    return {} if match is None else {"step_id": match[1]}


def _dropped(text: str) -> dict[str, object]:
    runs = [run.split(" to ") for found in _BLOCKS.findall(text) for run in found.split(", ")]
    return {"blocks": [[int(run[0]), int(run[-1])] for run in runs]} if runs else {}


def _home(text: str) -> dict[str, object]:
    match = _HOME.match(text)
    return {} if match is None else {**match.groupdict(), "residual": float(match["residual"])}


_READERS: Mapping[str, Callable[[str], dict[str, object]]] = {
    "capture_restarted": _restarted,
    "frames_dropped": _dropped,
    "home_residual": _home,
    "home_residual_large": _home,
}
