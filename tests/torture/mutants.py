"""`python -m tests.torture.mutants [--count N] [--seed S] [--of FILE...] [--jobs N]`: drawn mistakes in what keeps a
stand safe and its records sound. Each is made in a copy of the sources, in which the tests that concern its file run,
the quick ones first, then the cases of the torture rig, until one fails.

Beside this file, mutants.yaml says which tests concern which file, and which mistakes are none (`equivalent`). The
last lines say how many were found by what; before them stands each that was not, as the line that was and that is.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import yaml

from tests.addresses import WORKER
from tests.torture.lives import ROOT

TABLE = Path(__file__).with_name("mutants.yaml")
NOT_COPIED = shutil.ignore_patterns(".git", ".venv", ".hypothesis", ".*_cache")
TORTURE = "tests/system/test_torture.py"
MOST_LEFT = 0.05  # of those that are mistakes
_LONGEST_S, _SLOWER, _AT_LEAST_S = 3600.0, 5.0, 60.0  # than without a mistake: beyond that it hangs
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
_OTHER: dict[type, type] = {
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    **{ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And},
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult},
}


@dataclass(frozen=True, slots=True)
class Mutant:
    """A mistake in `file`, at `line`: its statements as they were and are, and the whole source with it."""

    file: str
    line: int
    was: str
    now: str
    source: str


def changes(node: ast.AST) -> Iterator[tuple[str, object]]:
    """What could be wrong at a node: the attribute, and its wrong value."""
    match node:
        case ast.Compare(ops=[operator]) if type(operator) in _OTHER:
            yield "ops", [_OTHER[type(operator)]()]
        case ast.BoolOp(op=operator) | ast.BinOp(op=operator) if type(operator) in _OTHER:
            yield "op", _OTHER[type(operator)]()
        case ast.If(test=test) if not isinstance(test, ast.Compare):  # else that is made of it already
            yield "test", ast.UnaryOp(ast.Not(), test)
        case ast.Constant(value=bool(value)):
            yield "value", not value
        case ast.Constant(value=int(value) | float(value)) if value:
            yield "value", value * 10
        case ast.Expr(value=ast.Call() | ast.Await() as call):
            yield "value", ast.copy_location(ast.Constant(None), call)
        case _:
            return


def nodes(source: str) -> Iterator[ast.AST]:
    """Of a source, but for what is in texts and decorators: no test holds their words."""
    left: deque[ast.AST] = deque([ast.parse(source)])
    while left:
        node = left.popleft()
        yield node
        passed: list[ast.AST] = getattr(node, "decorator_list", [])
        left += (
            each for each in ast.iter_child_nodes(node) if each not in passed and not isinstance(each, ast.JoinedStr)
        )


def places(source: str) -> Iterator[tuple[int, int]]:
    """Where a mistake could be made in it: the node's number, and which of its changes."""
    for number, node in enumerate(nodes(source)):
        yield from ((number, which) for which, _ in enumerate(changes(node)))


def mutant(file: str, source: str, number: int, which: int) -> Mutant:
    """The source of that file with a mistake at that place."""
    whole, *rest = nodes(source)
    was = ast.unparse(whole)
    node = (whole, *rest)[number]
    name, value = list(changes(node))[which]
    setattr(node, name, value)
    now = ast.unparse(ast.fix_missing_locations(whole))
    pairs = [pair for pair in zip(was.splitlines(), now.splitlines(), strict=True) if pair[0] != pair[1]]
    return Mutant(file, getattr(node, "lineno", 0), *("\n".join(map(str.strip, part)) for part in zip(*pairs)), now)


class Copy:
    """A copy of the project, in which mistakes are made one after the other; `number` tells those apart that are used
    at once."""

    def __init__(self, folder: Path, number: int) -> None:
        self.folder = folder / str(number)
        shutil.copytree(ROOT, self.folder, ignore=NOT_COPIED, symlinks=True)
        self._env = {**os.environ, "PYTHONPATH": str(self.folder), WORKER: str(12 + number), "TMPDIR": str(folder)}

    def found(self, names: str, limit_s: float) -> str:
        """The first test of those files that fails here, "" for none."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", *names.split()]
        process = subprocess.Popen(
            command,
            cwd=self.folder,
            env=self._env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            out, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return f"{names.partition(' ')[0]} or after it (hung)"
        if not process.returncode:
            return ""
        if process.returncode in (4, 5):
            raise OSError(f"{' '.join(command)}: {out[-2000:]}")
        return next(iter(_FAILED.findall(out)), f"exit status {process.returncode}")

    def with_mistake(self, made: Mutant, stages: list[tuple[str, float]]) -> str:
        """What finds it of the stages (tests, and how long they may take), "" for nothing."""
        path = self.folder / made.file
        right = path.read_bytes()
        path.write_text(made.source, encoding="utf-8")
        try:
            return next((found for names, limit_s in stages if (found := self.found(names, limit_s))), "")
        finally:
            path.write_bytes(right)
            shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)


def table() -> dict[str, Any]:
    """tests: by file, those that run one after the other, then together. equivalent: mistakes that are none, each a
    file, what was, what is and why."""
    return yaml.safe_load(TABLE.read_text(encoding="utf-8"))


def drawn(files: list[str], count: int, seed: int) -> list[Mutant]:
    """That many mistakes in those files, of all that could be made."""
    sources = {file: (ROOT / file).read_text(encoding="utf-8") for file in files}
    every = [(file, *place) for file, source in sources.items() for place in places(source)]
    chosen = random.Random(seed).sample(every, min(count, len(every)))
    return [mutant(file, sources[file], *place) for file, *place in chosen]


def limits_s(copy: Copy, stages: set[str]) -> dict[str, float]:
    """How long each of these may take; all must pass in a copy as it is."""
    limits: dict[str, float] = {}
    for names in sorted(stages):
        begun_s = time.monotonic()
        if found := copy.found(names, _LONGEST_S):
            raise SystemExit(f"{found} fails without any mistake")
        limits[names] = _AT_LEAST_S + _SLOWER * (time.monotonic() - begun_s)
    return limits


def main() -> int:
    """1 when more than one in twenty was not found."""
    parser = argparse.ArgumentParser(prog="python -m tests.torture.mutants", description="Are mistakes found?")
    known = table()
    equivalent = {(each["file"], each["was"], each["now"]): each["why"] for each in known["equivalent"]}
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--of", nargs="+", default=list(known["tests"]))
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    begun_s, how = time.monotonic(), Counter[str]()
    made = drawn(given.of, given.count, given.seed)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(given.jobs) as pool:
        free = SimpleQueue[Copy]()
        for number in range(given.jobs):
            free.put(Copy(Path(folder), number))
        copy = free.get()
        stages = {file: [*known["tests"][file], TORTURE] for file in given.of}
        limits = limits_s(copy, {names for each in stages.values() for names in each})
        free.put(copy)

        def look(each: Mutant) -> str:
            if (each.file, each.was, each.now) in equivalent:
                return "equivalent"
            copy = free.get()
            try:
                return copy.with_mistake(each, [(names, limits[names]) for names in stages[each.file]])
            finally:
                free.put(copy)

        for count, (each, found) in enumerate(zip(made, pool.map(look, made), strict=True), 1):
            how[_kind(found)] += 1
            said = found or f"NOT FOUND\n    was: {each.was}\n    now: {each.now}"
            minutes_left = (time.monotonic() - begun_s) / count * (len(made) - count) / 60.0
            sys.stdout.write(f"[{count}/{len(made)}, {minutes_left:.0f} min left] {each.file}:{each.line}: {said}\n")
            sys.stdout.flush()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    sys.stdout.write(
        f"{len(made)} drawn: {', '.join(f'{number} {name}' for name, number in how.most_common())}; "
        f"{(time.monotonic() - begun_s) / 60.0:.0f} min, {(used.ru_utime + used.ru_stime) / 60.0:.0f} min of processor time\n"
    )
    return int(how["not found"] > MOST_LEFT * (len(made) - how["equivalent"]))


def _kind(found: str) -> str:
    if not found or found == "equivalent":
        return found or "not found"
    return "found by the torture rig" if found.startswith(TORTURE) else "found by tests"


if __name__ == "__main__":
    sys.exit(main())
