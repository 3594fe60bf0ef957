"""Stands for the process that fits the drift model: its decisions are those of a file in the session, one for each
number of visits; it notes what it was asked."""

import json
import os
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

LEFT_NAME = "test-left"
ANSWERS, ASKED = "answers.json", "asked.jsonl"


def decide_next_visit(session: str, asked: Mapping[str, Any]) -> Any:
    with (Path(session) / ASKED).open("a") as file:
        file.write(json.dumps(asked) + "\n")
    found = json.loads((Path(session) / ANSWERS).read_text())[len((Path(session) / ASKED).read_text().splitlines()) - 1]
    if found == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if found == "hang":
        threading.Event().wait(60.0)
    return found
