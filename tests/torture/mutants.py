"""`python -m tests.torture.mutants [--count N] [--seed S] [--of FILE...] [--jobs N]`: drawn mistakes in what keeps a
stand safe and its records sound. Each is made in a copy of the sources, in which the tests that concern its file run,
the quick ones first, then the cases of the torture rig, until one fails.

Beside this file, mutants.yaml says which tests concern which file, and which mistakes are none (`equivalent`). The
last lines say how many were found by what; before them stands each that was not, as the line that was and that is.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.addresses import WORKER
from tests.torture.lives import ROOT

TABLE = Path(__file__).with_name("mutants.yaml")
NOT_COPIED = shutil.ignore_patterns(".git", ".venv", ".hypothesis", ".*_cache")
TORTURE = "tests/system/test_torture.py"
MOST_LEFT = 0.05  # of those that are mistakes
# What takes so much more of the processor's time than without a mistake hangs; so does what waits, on a machine that
# has as much to do for others.
_LONGEST_S, _MORE, _AT_LEAST_S, _SLOWER = 900.0, 3.0, 10.0, 20.0
_OURS = {path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()} | {"tests"}
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
    texts = ["\n".join(pair[which].strip() for pair in pairs) for which in (0, 1)]
    return Mutant(file, getattr(node, "lineno", 0), texts[0], texts[1], now)


class Copy:
    """A copy of the project, in which mistakes are made one after the other, in a process of its own; `number` tells
    those apart that are used at once. What others wrote is imported once: each run of tests is forked from there."""

    def __init__(self, folder: Path, number: int) -> None:
        self.folder = folder / f"copy-{number}"
        shutil.copytree(ROOT, self.folder, ignore=NOT_COPIED, symlinks=True)
        self._out = folder / f"out-{number}"
        self._modules = folder / f"modules-{number}"
        self._is_prepared = False
        self._enough: dict[str, float] = {}
        self._env = {"PYTHONPATH": str(self.folder), WORKER: str(12 + number), "TMPDIR": str(folder)}

    def found(self, names: str, processor_s: float) -> str:
        """The first test of those files that fails here, "" for none; so much time of the processor is enough."""
        tests = multiprocessing.get_context("fork").Process(target=self._run, args=(names.split(), round(processor_s)))
        tests.start()
        tests.join(_SLOWER * processor_s)
        if not self._is_prepared and self._modules.is_file():
            self._prepare()
        if tests.exitcode is None:
            os.killpg(tests.ident or 0, signal.SIGKILL)
            tests.join()
            return f"{names.partition(' ')[0]} or after it (hung)"
        if not tests.exitcode:
            return ""
        out = self._out.read_text(encoding="utf-8", errors="replace")
        if tests.exitcode in (4, 5):
            raise OSError(f"{names}: {out[-2000:]}")
        return next(iter(_FAILED.findall(out)), f"{names.partition(' ')[0]} or after it ({tests.exitcode})")

    def with_mistake(self, made: Mutant, stages: list[str]) -> str:
        """What finds it of the stages, tests that run together; "" for nothing."""
        path = self.folder / made.file
        right = path.read_bytes()
        for names in stages:
            enough_s = self._enough_s(names)
            path.write_text(made.source, encoding="utf-8")
            try:
                found = self.found(names, enough_s)
            finally:
                path.write_bytes(right)
                shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)
            if found:
                return found
        return ""

    def _enough_s(self, names: str) -> float:
        """How much of the processor's time is enough for these tests; all must pass as it is."""
        if names not in self._enough:
            begun_s = _processor_s()
            if found := self.found(names, _LONGEST_S):
                raise ValueError(f"{found} fails without any mistake")
            self._enough[names] = _AT_LEAST_S + _MORE * (_processor_s() - begun_s)
        return self._enough[names]

    def _prepare(self) -> None:
        """Import what the first run has imported of others."""
        self._is_prepared = True
        for name in self._modules.read_text(encoding="utf-8").split():
            with suppress(Exception):
                importlib.import_module(name)

    def _run(self, names: list[str], processor_s: int) -> None:
        """In a process of its own."""
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (processor_s, processor_s))
        os.chdir(self.folder)
        os.environ |= self._env
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False
        sys.path.insert(0, str(self.folder))
        for name in [name for name in sys.modules if name.partition(".")[0] in _OURS]:
            del sys.modules[name]
        with self._out.open("wb") as out:
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
        tempfile.tempdir = None
        status = pytest.main(["-x", "-q", "-n0", "--assert=plain", "-p", "no:cacheprovider", *names])
        others = [name for name in sys.modules if name.partition(".")[0] not in {*_OURS, "__main__", "conftest"}]
        self._modules.write_text("\n".join(others), encoding="utf-8")
        sys.exit(status)


def table() -> dict[str, Any]:
    """tests: by file, those that run one after the other, then together. equivalent: mistakes that are none, each a
    file, what was, what is and why."""
    return yaml.safe_load(TABLE.read_text(encoding="utf-8"))


def draw_mutants(files: list[str], count: int, seed: int) -> list[Mutant]:
    """That many mistakes in those files, of all that could be made."""
    sources = {file: (ROOT / file).read_text(encoding="utf-8") for file in files}
    every = [(file, *place) for file, source in sources.items() for place in places(source)]
    chosen = random.Random(seed).sample(every, min(count, len(every)))
    return [mutant(file, sources[file], *place) for file, *place in chosen]


_here: list[Copy] = []
"""Of a process of the pool, the one it works in."""


def _begin(folder: Path, numbers: SimpleQueue[int]) -> None:
    _here.append(Copy(folder, numbers.get()))


def _processor_s() -> float:
    """Of what was started from here, and has ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _find_killer(made: Mutant, stages: list[str]) -> str:
    return _here[0].with_mistake(made, stages)


def main() -> int:
    """1 when more than one in twenty was not found."""
    parser = argparse.ArgumentParser(prog="python -m tests.torture.mutants", description="Are mistakes found?")
    known = table()
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--of", nargs="+", default=list(known["tests"]))
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    begun_s, how = time.monotonic(), Counter[str]()
    none = {(each["file"], each["was"], each["now"]) for each in known["equivalent"]}
    every = draw_mutants(given.of, given.count, given.seed)
    made = [each for each in every if (each.file, each.was, each.now) not in none]
    stages = {file: [*known["tests"][file], TORTURE] for file in given.of}
    context = multiprocessing.get_context("spawn")
    numbers: SimpleQueue[int] = context.SimpleQueue()
    for number in range(given.jobs):
        numbers.put(number)
    with (
        tempfile.TemporaryDirectory(prefix="mutants-") as folder,
        ProcessPoolExecutor(given.jobs, context, _begin, (Path(folder), numbers)) as pool,
    ):
        looks = [pool.submit(_find_killer, each, stages[each.file]) for each in made]
        for count, (each, look) in enumerate(zip(made, looks, strict=True), 1):
            found = look.result()
            how[_kind(found)] += 1
            text = found or f"NOT FOUND\n    was: {each.was}\n    now: {each.now}"
            minutes_left = (time.monotonic() - begun_s) / count * (len(made) - count) / 60.0
            sys.stdout.write(f"[{count}/{len(made)}, {minutes_left:.0f} min left] {each.file}:{each.line}: {text}\n")
            sys.stdout.flush()
    minutes, processor_min = (time.monotonic() - begun_s) / 60.0, _processor_s() / 60.0
    counts = ", ".join(f"{number} {name}" for name, number in how.most_common())
    sys.stdout.write(
        f"{len(every)} drawn: {len(every) - len(made)} equivalent, {counts}; "
        f"{minutes:.0f} min, {processor_min:.0f} min of processor time\n"
    )
    return int(how["not found"] > MOST_LEFT * len(made))


def _kind(found: str) -> str:
    if not found:
        return "not found"
    return "found by the torture rig" if found.startswith(TORTURE) else "found by tests"


if __name__ == "__main__":
    sys.exit(main())
