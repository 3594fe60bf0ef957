"""How a command ends, each with one sentence (with --json also as a document): 0 as asked, 1 failed or damaged, 2 bad
input, 3 a run that is complete and recorded but could not be reported, 4 a run in virtual time that was held and nobody
reset, 130 interrupted."""

from __future__ import annotations

import traceback
from collections.abc import Generator
from contextlib import contextmanager

import typer

from thermostand.foundation.errors import ConfigError, Interrupted, NotReset, NotThere, StandError
from thermostand.foundation.output import output
from thermostand.foundation.usage import ended, failed

FAILED = 1
BAD_INPUT = 2
NOT_REPORTED = 3
NOT_RESET = 4
INTERRUPTED = 130


@contextmanager
def one_line_errors() -> Generator[None]:
    """What is raised inside becomes its sentence and its exit status."""
    try:
        yield
    except (ConfigError, NotThere) as error:
        raise _failed(error, BAD_INPUT) from error
    except BrokenPipeError:  # the reader of our output has closed it; typer ends quietly
        raise
    except Interrupted as error:
        raise ended(error, INTERRUPTED) from error
    except NotReset as error:
        raise _failed(error, NOT_RESET) from error
    except (StandError, OSError) as error:
        raise _failed(error, FAILED) from error
    except KeyboardInterrupt as error:
        raise ended("interrupted", INTERRUPTED) from error


def _failed(error: BaseException, status: int) -> typer.Exit:
    """With its sentence; with -v where it came from first."""
    if output().verbose:
        typer.echo("".join(traceback.format_exception(error)), err=True, nl=False)
    return failed(error, status)
