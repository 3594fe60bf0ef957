"""`make bench`: every benchmark, one table. `python -m tests.bench abort camera` runs the named ones only."""

from __future__ import annotations

import importlib
import platform
import sys
import tempfile
import time
import traceback
from pathlib import Path

import cv2

from tests.bench.figures import Figure, Missing, format_table, make_skipped, report_progress

BENCHMARKS = (
    *("virtual_time", "protocol", "abort", "jitter", "viewers", "regulators", "camera", "calibration", "codec"),
    *(
        "line_rate",
        "reading",
        "arrays",
        "listing",
        "markers",
        "photographs",
        "claimed_variances",
        "drift",
        "coverage",
        "datasheet",
        "certificate",
        "soaks",
    ),
    *("adaptive", "warp", "c_header", "pipeline", "cluster", "identification", "start", "stop", "page"),
)
"""Modules of this folder with `figures(directory)`, which gives the lines of the table."""


def main() -> None:
    """Run the benchmarks and print what there is, also when interrupted; one that fails does not keep the others."""
    unknown = [name for name in sys.argv[1:] if name not in BENCHMARKS]
    if unknown:
        sys.exit(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}")
    found: list[Figure] = []
    failed: list[str] = []
    begin_s = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="bench-") as folder:
            for name in sys.argv[1:] or BENCHMARKS:
                report_progress(f"[{time.monotonic() - begin_s:4.0f} s] {name}")
                try:
                    for figure in importlib.import_module(f"tests.bench.{name}").figures(Path(folder)):
                        found.append(figure)
                except Missing as error:
                    found.append(make_skipped(name, error))
                except Exception as error:  # noqa: BLE001 - whatever it is, the others are wanted
                    traceback.print_exc()
                    found.append(make_skipped(name, f"failed: {error}"))
                    failed.append(name)
    finally:
        sys.stdout.write(f"\n{_machine()}, {time.monotonic() - begin_s:.0f} s\n\n{format_table(found)}")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


def _machine() -> str:
    return f"Python {platform.python_version()}, OpenCV {cv2.__version__}, {platform.system()} {platform.machine()}"


if __name__ == "__main__":
    main()
