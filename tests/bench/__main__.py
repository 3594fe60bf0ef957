"""`make bench`: every benchmark, one table. `python -m tests.bench modbus camera` runs the named ones only."""

from __future__ import annotations

import platform
import sys
import tempfile
import time
import traceback
from pathlib import Path

import cv2

from tests.bench import (
    abort,
    c_header,
    calibration,
    camera,
    claimed_variances,
    cluster,
    codec,
    datasheet,
    drift,
    dwells,
    identification,
    jitter,
    known,
    line_rate,
    listing,
    loop,
    markers,
    modbus,
    night,
    page,
    photographs,
    pipeline,
    reading,
    recorder,
    regulators,
    simulator,
    start,
    stop,
    viewers,
    virtual_time,
    warp,
    ximc,
)
from tests.bench.figures import Figure, progress, skipped, table

BENCHMARKS = {
    "virtual_time": virtual_time.figures,
    "night": night.figures,
    "abort": abort.figures,
    "jitter": jitter.figures,
    "viewers": viewers.figures,
    "regulators": regulators.figures,
    "loop": loop.figures,
    "modbus": modbus.figures,
    "ximc": ximc.figures,
    "camera": camera.figures,
    "calibration": calibration.figures,
    "codec": codec.figures,
    "recorder": recorder.figures,
    "line_rate": line_rate.figures,
    "reading": reading.figures,
    "listing": listing.figures,
    "markers": markers.figures,
    "photographs": photographs.figures,
    "claimed_variances": claimed_variances.figures,
    "drift": drift.figures,
    "datasheet": datasheet.figures,
    "dwells": dwells.figures,
    "known": known.figures,
    "warp": warp.figures,
    "c_header": c_header.figures,
    "pipeline": pipeline.figures,
    "cluster": cluster.figures,
    "identification": identification.figures,
    "simulator": simulator.figures,
    "start": start.figures,
    "stop": stop.figures,
    "page": page.figures,
}


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
                progress(f"[{time.monotonic() - begin_s:4.0f} s] {name}")
                try:
                    found += BENCHMARKS[name](Path(folder))
                except Exception as error:  # noqa: BLE001 - whatever it is, the others are wanted
                    traceback.print_exc()
                    found.append(skipped(name, f"failed: {error}"))
                    failed.append(name)
    finally:
        sys.stdout.write(f"\n{_machine()}, {time.monotonic() - begin_s:.0f} s\n\n{table(found)}")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


def _machine() -> str:
    return f"Python {platform.python_version()}, OpenCV {cv2.__version__}, {platform.system()} {platform.machine()}"


if __name__ == "__main__":
    main()
