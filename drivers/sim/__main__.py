"""`python -m drivers.sim`: one process is one simulated laboratory. Its description comes as JSON on standard input.

Prints `ready` when every fake answers; ends on SIGTERM or SIGINT; exits with 2 and one line when it cannot start.
"""

from __future__ import annotations

import signal
import sys
import threading

from drivers.documents import parse_document
from drivers.interface import ConfigError
from drivers.sim.control import serve_control
from drivers.sim.laboratory import Laboratory, LaboratorySpec


def main() -> int:
    """Build the laboratory, serve it, take it down."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        spec = parse_document(sys.stdin.read(), LaboratorySpec, "laboratory")
        laboratory = Laboratory(spec)
    except (ConfigError, OSError) as error:
        print(f"{error}", file=sys.stderr)  # noqa: T201 - the process' answer to who started it
        return 2
    control = serve_control(laboratory)
    print("ready", flush=True)  # noqa: T201 - the process' answer to who started it
    stop.wait()
    control.close()
    laboratory.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
