"""How a command ends, each with one sentence (with --json also as a document): 0 as asked, 1 failed or damaged, 2 bad
input, 3 a run that is complete and recorded but could not be reported, 4 a run in virtual time that was held and nobody
reset, 130 interrupted."""

from __future__ import annotations

import traceback
from collections.abc import Generator
from contextlib import contextmanager

import typer

from thermostand.foundation.errors import ConfigError, Interrupted, NotFound, NotReset, StandError
from thermostand.foundation.output import get_output
from thermostand.foundation.usage import report_end, report_failure

FAILED = 1
BAD_INPUT = 2
NOT_REPORTED = 3
NOT_RESET = 4
INTERRUPTED = 130


@contextmanager
def exit_on_error() -> Generator[None]:
    """What is raised inside becomes its sentence and its exit status."""
    try:
        yield
    except (ConfigError, NotFound) as error:
        raise _make_exit(error, BAD_INPUT) from error
    except BrokenPipeError:  # the reader of our output has closed it; typer ends quietly
        raise
    except Interrupted as error:
        raise report_end(error, INTERRUPTED) from error
    except NotReset as error:
        raise _make_exit(error, NOT_RESET) from error
    except (StandError, OSError) as error:
        raise _make_exit(error, FAILED) from error
    except KeyboardInterrupt as error:
        raise report_end("interrupted", INTERRUPTED) from error


def _make_exit(error: BaseException, status: int) -> typer.Exit:
    """Make the exit with its sentence; with -v it shows first where the error came from."""
    if get_output().verbose:
        typer.echo("".join(traceback.format_exception(error)), err=True, nl=False)
    return report_failure(error, status)
