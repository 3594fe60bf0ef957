"""`python -m thermostand.drivers.sim`: one process is one simulated laboratory. Its description comes as JSON on
standard input.

Prints the addresses at which it answers (JSON, one line) when every fake does; ends on SIGTERM, SIGINT or the control
socket's `quit`; exits with 2 and one line when it cannot start. When its parent process dies, it lives on for a minute,
as a real laboratory would: long enough to see the heater's dead-man drop.

`python -m thermostand.drivers.sim --faults` prints the table of faults (JSON) instead.
"""

from __future__ import annotations

import json
import os
import signal
import sys

from thermostand.drivers.sim.control import serve_control
from thermostand.drivers.sim.laboratory import Laboratory, LaboratorySpec
from thermostand.drivers.sim.laboratory_faults import FaultSchedule, list_known_faults, make_table, parse_fault
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.stop_signal import StopSignal

# Longer than the 15 s after which a dead-man relay drops, so that this can be watched behind a killed daemon.
_ORPHAN_LIMIT_S = 60.0
_TICK_S = 0.1


def main() -> int:
    """Build the laboratory, serve it, take it down."""
    if sys.argv[1:] == ["--faults"]:
        print(json.dumps(make_table()))  # noqa: T201 - the answer
        return 0
    ending, parent = StopSignal((signal.SIGTERM, signal.SIGINT)), os.getppid()
    try:
        spec = parse_document(sys.stdin.read(), LaboratorySpec, "laboratory")
        laboratory = Laboratory(spec)
    except (ConfigError, OSError) as error:
        print(f"{error}", file=sys.stderr)  # noqa: T201 - the process' answer to who started it
        return 2
    try:
        faults = [parse_fault(text, list_known_faults(laboratory)) for text in spec.faults]
        schedule = FaultSchedule(laboratory, faults)
    except ConfigError as error:
        laboratory.close()
        print(f"{error}", file=sys.stderr)  # noqa: T201 - as above
        return 2
    control = serve_control(laboratory, schedule, ending.ask)
    addresses = {**laboratory.addresses, "control": control.address}
    print(json.dumps(addresses), flush=True)  # noqa: T201 - the process' answer to who started it
    orphaned_s = 0.0
    while not ending.wait(_TICK_S) and orphaned_s < _ORPHAN_LIMIT_S:
        try:
            schedule.tick()
        except ConfigError as error:
            print(f"{error}", file=sys.stderr)  # noqa: T201 - the laboratory stays as it is
        orphaned_s += _TICK_S * (os.getppid() != parent)
    laboratory.close()
    control.close()  # last: who finds it gone finds every other address free
    return 0


if __name__ == "__main__":
    sys.exit(main())
