"""`python -m tests.torture.mutants [--count N] [--seed S] [--of FILE...]`: drawn mistakes in what keeps a stand safe
and its records sound. Each is made in a copy of the sources, in which cases of the torture rig run until one is broken.

The last line says how many were found; before it stands each that was not, with its line.
"""

from __future__ import annotations

import argparse
import ast
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.torture.lives import ROOT

OF = (
    *("stand/guarding/guard.py", "stand/guarding/interlocks.py", "stand/guarding/rules.py", "stand/safety.py"),
    *("stand/interlock.py", "stand/gate.py", "stand/chamber/keeper.py", "stand/chamber/permits.py"),
    *("stand/running/memory/journal.py", "stand/running/memory/fold.py", "stand/running/executing/executor.py"),
    *("stand/running/executing/actions.py", "recording/repair/salvage.py"),
)
PACKAGES = (
    "foundation",
    "drivers",
    "experiments",
    "recording",
    "markers",
    "stand",
    "compensation",
    "thermostand",
    "tests",
)
CASES = "tests/torture/cases"
LIMIT_S = 900.0  # of one case: a mutant may hang
_OTHER: dict[type, type] = {
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    **{ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And},
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult},
}


def changes(node: ast.AST) -> Iterator[tuple[str, object]]:
    """What could be wrong at a node: the attribute, and its wrong value."""
    match node:
        case ast.Compare(ops=[operator]) if type(operator) in _OTHER:
            yield "ops", [_OTHER[type(operator)]()]
        case ast.BoolOp(op=operator) | ast.BinOp(op=operator) if type(operator) in _OTHER:
            yield "op", _OTHER[type(operator)]()
        case ast.If(test=test):
            yield "test", ast.UnaryOp(ast.Not(), test)
        case ast.Constant(value=bool(value)):
            yield "value", not value
        case ast.Constant(value=int(value) | float(value)) if value:
            yield "value", value * 10
        case ast.Expr(value=ast.Call() | ast.Await() as call):
            yield "value", ast.copy_location(ast.Constant(None), call)
        case _:
            return


def places(source: str) -> Iterator[tuple[int, int]]:
    """Where a mistake could be made in it: the node's number, and which of its changes."""
    for number, node in enumerate(ast.walk(ast.parse(source))):
        yield from ((number, which) for which, _ in enumerate(changes(node)))


def mutant(source: str, number: int, which: int) -> tuple[int, str]:
    """The line of that mistake, and the whole source with it."""
    tree = ast.parse(source)
    node = list(ast.walk(tree))[number]
    name, value = list(changes(node))[which]
    setattr(node, name, value)
    return getattr(node, "lineno", 0), ast.unparse(ast.fix_missing_locations(tree))


def find_broken(place: Path, cases: list[Path]) -> str:
    """The first case that is broken there; "" for none."""
    for case in cases:
        command = [sys.executable, "-m", "tests.torture", "--case", str(case)]
        try:
            ended = subprocess.run(command, cwd=place, capture_output=True, timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            return f"{case.stem} (hung)"
        if ended.returncode:
            return case.stem
    return ""


def main() -> int:
    """1 when more than one in twenty was not found."""
    parser = argparse.ArgumentParser(prog="python -m tests.torture.mutants", description="Are mistakes found?")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--of", nargs="+", default=[name for name in OF if (ROOT / name).exists()])
    given = parser.parse_args()
    drawn, begun_s = random.Random(given.seed), time.monotonic()
    every = [(name, *place) for name in given.of for place in places((ROOT / name).read_text(encoding="utf-8"))]
    chosen, alive = drawn.sample(every, min(given.count, len(every))), 0
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        place = Path(folder)
        for package in PACKAGES:
            shutil.copytree(ROOT / package, place / package, ignore=shutil.ignore_patterns("__pycache__"))
        cases = sorted((place / CASES).glob("*.yaml"))
        for count, (name, number, which) in enumerate(chosen, 1):
            right = (place / name).read_text(encoding="utf-8")
            line, wrong = mutant(right, number, which)
            (place / name).write_text(wrong, encoding="utf-8")
            found = find_broken(place, cases)
            (place / name).write_text(right, encoding="utf-8")
            alive += not found
            minutes_left = (time.monotonic() - begun_s) / count * (len(chosen) - count) / 60.0
            said = f"found by {found}" if found else "NOT FOUND"
            sys.stdout.write(f"{name}:{line}: {said}    [{count}/{len(chosen)}, {minutes_left:.0f} min left]\n")
            sys.stdout.flush()
    sys.stdout.write(f"{len(chosen) - alive} of {len(chosen)} were found\n")
    return int(alive > len(chosen) / 20)


if __name__ == "__main__":
    sys.exit(main())
