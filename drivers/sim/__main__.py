"""`python -m drivers.sim`: one process is one simulated laboratory. Its description comes as JSON on standard input.

Prints the addresses at which it answers (JSON, one line) when every fake does; ends on SIGTERM, SIGINT or the control
socket's `quit`; exits with 2 and one line when it cannot start. When its parent process dies, it lives on for a minute,
as a real laboratory would: long enough to see the heater's dead-man drop.
"""

from __future__ import annotations

import json
import os
import signal
import sys

from drivers.sim.control import serve_control
from drivers.sim.laboratory import Laboratory, LaboratorySpec
from foundation.documents import parse_document
from foundation.ending import Ending
from foundation.errors import ConfigError

_ORPHAN_LIMIT_S = 60


def main() -> int:
    """Build the laboratory, serve it, take it down."""
    ending, parent = Ending((signal.SIGTERM, signal.SIGINT)), os.getppid()
    try:
        spec = parse_document(sys.stdin.read(), LaboratorySpec, "laboratory")
        laboratory = Laboratory(spec)
    except (ConfigError, OSError) as error:
        print(f"{error}", file=sys.stderr)  # noqa: T201 - the process' answer to who started it
        return 2
    control = serve_control(laboratory, ending.ask)
    addresses = {**laboratory.addresses, "control": control.address}
    print(json.dumps(addresses), flush=True)  # noqa: T201 - the process' answer to who started it
    orphaned_s = 0
    while not ending.wait(1.0) and orphaned_s < _ORPHAN_LIMIT_S:
        orphaned_s += os.getppid() != parent
    control.close()
    laboratory.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
