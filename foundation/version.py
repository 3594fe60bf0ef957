"""The version of the program, and the commit that it was made from."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

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


@cache
def read_commit() -> str:
    """Read the commit, as pip has noted it or as git says it of the folder that the program runs in; "" where it is not
    known, and with a `+` behind it where files were changed since."""
    import importlib.metadata

    noted = json.loads(importlib.metadata.distribution("thermostand").read_text("direct_url.json") or "{}")
    if commit := noted.get("vcs_info", {}).get("commit_id"):
        return str(commit)[:12]
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return ""
    with suppress(OSError, subprocess.SubprocessError):
        command = ["git", "-C", str(root), "describe", "--always", "--exclude=*", "--abbrev=12", "--dirty=+"]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    return ""
