"""`make benchmark`: methods of compensation on sessions of drawn cameras, against the truth. `python -m tests.benchmark
my_method.py` scores one more; `--cameras 3` takes fewer of them; `--write FOLDER` writes the sessions for other
programs.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from itertools import product
from pathlib import Path

import numpy as np

from .benchmark_cases import CAMERAS, GROUPS, TRAININGS, Case, make_case
from .methods import METHODS
from .scoring import Method, Score, format_table, score_method


def main() -> None:
    """Score, and print one table for each group as soon as it is complete."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmark", description=__doc__)
    parser.add_argument("method", nargs="*", type=Path, help="files with NAME and fit(training)")
    parser.add_argument("--cameras", type=int, default=CAMERAS, help="of each group")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="the sessions as .npz files, and no scores")
    given = parser.parse_args()
    if given.write is not None:
        for way, group, number in product(TRAININGS, GROUPS, range(given.cameras)):
            write(make_case(group, number, way), given.write)
        return
    methods = {**METHODS, **dict(load_method(path) for path in given.method)}
    begin_s = time.monotonic()
    for way, group in product(TRAININGS, GROUPS):
        found: list[Score] = []
        for number in range(given.cameras):
            one = make_case(group, number, way)
            for name, method in methods.items():
                found += score_method(name, method, one)
            sys.stderr.write(f"  [{time.monotonic() - begin_s:4.0f} s] {way}, {group}, camera {number}\n")
        sys.stdout.write(f"{format_table(found, methods)}\n")
        sys.stdout.flush()


def load_method(path: Path) -> tuple[str, Method]:
    """NAME and fit of a file."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.is_file():
        sys.exit(f"{path}: not a Python file with NAME and fit(training)")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.NAME, module.fit


def write(one: Case, folder: Path) -> None:
    """Two files for each camera: what may be learned from, and for each task what is asked, with the answer."""
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{TRAININGS.index(one.learned_from)}-{GROUPS.index(one.group)}-{one.camera:02d}"
    for part, known in (
        ("training", one.training),
        *((f"task-{k}", q.session) for k, q in enumerate(one.questions, 1)),
    ):
        history = known.histories[0]
        columns = {key: getattr(known, key) for key in ("time_ns", "role", "chamber_degC", "camera_degC", "air_degC")}
        telemetry = {key: getattr(history, key) for key in ("ambient_ns", "ambient_degC", "powered_ns", "powered")}
        own = {"own_ns": history.camera_ns, "own_degC": history.camera_degC, "centres_px": known.centres_px}
        np.savez_compressed(folder / f"{name}-{part}.npz", **columns, **telemetry, **own)
    answers = {
        f"task_{k}_{key}": getattr(q, key)
        for k, q in enumerate(one.questions, 1)
        for key in ("frames", "seen_px", "reference_px")
    }
    np.savez_compressed(folder / f"{name}-answers.npz", **answers)


if __name__ == "__main__":
    main()
