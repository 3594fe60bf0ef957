"""The `stand` command's entry: a Ctrl-C while the commands are still being imported ends it with a line as well."""

from __future__ import annotations

import atexit
import gc
import sys

_INTERRUPTED = 130  # exit_codes.INTERRUPTED, which cannot be imported before the interrupt is caught


def app() -> None:
    """Run the command line; ends the process."""
    atexit.register(gc.freeze)  # else all that was imported is searched for garbage first: 0.25 s of processor time
    try:
        from thermostand.stand.commands.command_table import app as commands
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; nothing was started\n")
        sys.exit(_INTERRUPTED)
    commands()


if __name__ == "__main__":
    app()
