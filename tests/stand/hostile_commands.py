"""Runs commands, each in a process of its own that is forked from one that has imported everything.

`python -m tests.stand.hostile_commands` reads a list of words as JSON from each line, the program first, and answers
with a line of JSON: exit status, seconds, greatest memory in bytes, and all that was printed.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module

LIMIT_S = 90
CRASHED = 70
MEMORY_LIMIT_BYTES = 6 << 30  # of addresses: what takes more is ended before the machine is


@dataclass(frozen=True)
class Answer:
    """status: the exit code, -9 when it took too long. memory_bytes: resident, at most."""

    status: int
    seconds: float
    memory_bytes: int
    output: str


def run_here(words: list[str]) -> None:
    """In the forked process; does not return."""
    from thermostand.compensation.cli import app as compensate
    from thermostand.stand.commands.command_table import app as stand

    status = CRASHED
    try:
        {"stand": stand, "compensate": compensate}[words[0]](words[1:], prog_name=words[0])
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        if status == CRASHED:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def answer(words: list[str]) -> dict[str, object]:
    with tempfile.TemporaryFile() as pipe:
        begin_s = time.monotonic()
        child = os.fork()
        if child == 0:
            null = os.open(os.devnull, os.O_RDONLY)
            for number, target in ((0, null), (1, pipe.fileno()), (2, pipe.fileno())):
                os.dup2(null if number == 0 else target, number)
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_BYTES, MEMORY_LIMIT_BYTES))
            signal.alarm(LIMIT_S)  # ends it
            run_here(words)
        _, status, usage = os.wait4(child, 0)
        seconds = time.monotonic() - begin_s
        pipe.seek(0)
        text = pipe.read().decode(errors="replace")
    code = os.waitstatus_to_exitcode(status)
    return {"status": code, "seconds": seconds, "memory_bytes": usage.ru_maxrss * 1024, "output": text[-20_000:]}


def main() -> None:
    for module in sys.argv[1:]:
        import_module(module)  # once for all
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        answers.write(json.dumps(answer(json.loads(line))) + "\n")
        answers.flush()


@contextmanager
def commands(*modules: str):
    """`ask(word, ...)` runs a command and gives its Answer. modules: what the commands are going to import."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path), "COLUMNS": "200"}
    command = [sys.executable, "-m", "tests.stand.hostile_commands", *modules]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:

        def ask(*words: object) -> Answer:
            process.stdin.write(json.dumps([str(word) for word in words]) + "\n")
            process.stdin.flush()
            return Answer(**json.loads(process.stdout.readline()))

        try:
            yield ask
        finally:
            process.stdin.close()
            process.terminate()


if __name__ == "__main__":
    main()
