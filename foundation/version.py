"""The version of the program."""

from __future__ import annotations

import os
import re
import sys
from contextlib import suppress

_INFO = re.compile(r"thermostand-(.+)\.dist-info")


def read_version() -> str:
    """Read the version from the name of the folder that says what is installed; importlib.metadata, which takes as long
    to import as all that lists sessions, is asked when there is none, or there are several."""
    found: set[str] = set()
    for folder in sys.path:
        with suppress(OSError):
            found.update(match[1] for name in os.listdir(folder or ".") if (match := _INFO.fullmatch(name)))
    if len(found) == 1:
        return found.pop()
    import importlib.metadata

    return importlib.metadata.version("thermostand")
