"""A region of 200 x 200 px of every frame by `session.to_xarray()`, beside reading and decompressing the same chunks.

400 frames of 5 MP with 3 DN of noise, as the recorder compresses them, and 3,600 small ones, of which the region takes
as much memory as of large ones; each round is a process of its own, so that its memory is its own, too. The peer reads
the chunks by their places and gives them to zstandard, in one thread, without looking at a CRC.
"""

from __future__ import annotations

import importlib
import json
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import zstandard
from mcap.writer import CompressionType

from tests.bench.figures import Figure, compare, measure_in_turns, report_progress, set_upper_goal, set_upper_ratio_goal
from tests.bench.reading import ATTACHMENTS, FRAME_PERIOD_NS, METADATA, START_NS, HEIGHT_px, WIDTH_px, write_telemetry
from tests.recording.frame_records import CAMERA_TOPICS, make_frame_records
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.readings import Frame
from thermostand.recording.format.layout import FRAMES
from thermostand.recording.format.mcap_bytes import RECORD, parse_chunk_head
from thermostand.recording.format.records import list_frame_places
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.segment import SeriesSpec
from thermostand.recording.writing.series import Series

COUNT = 400
MANY, SMALL_px = 3600, (600, 800)
ROUNDS = 5


def figures(directory: Path) -> list[Figure]:
    """The ratio of the times, the memory, and what opening takes."""
    session = directory / "arrays"
    report_progress(f"arrays, {COUNT} frames are written")
    _write(session, COUNT, (HEIGHT_px, WIDTH_px))
    many = directory / "many"
    _write(many, MANY, SMALL_px)
    try:
        runs: list[dict[str, float]] = []

        def ours() -> float:
            runs.append(_measure(session, "region"))
            return runs[-1]["s"]

        own, peer = measure_in_turns(ours, lambda: _measure(session, "chunks")["s"], ROUNDS)
        opened = [run["open_ms"] for run in runs]
        of_many = _measure(many, "region")
    finally:
        shutil.rmtree(session, ignore_errors=True)
        shutil.rmtree(many, ignore_errors=True)
    what = f"arrays: 200 x 200 px of {COUNT} frames"
    return [
        set_upper_ratio_goal(1.3, compare(what, "s", "read and zstd alone", own, peer)),
        set_upper_goal(
            300,
            Figure(f"arrays: 200 x 200 px of {MANY} frames", "MB", of_many["MB"], "more than with the packages loaded"),
        ),
        set_upper_goal(200, Figure(f"arrays: to_xarray, camera, {MANY} frames", "ms", of_many["open_ms"])),
        set_upper_goal(
            200, Figure(f"arrays: to_xarray, camera, {COUNT} frames", "ms", sorted(opened)[len(opened) // 2])
        ),
    ]


def _write(session: Path, count: int, size_px: tuple[int, int]) -> None:
    folder = session / FRAMES
    folder.mkdir(parents=True)
    form = SeriesSpec(folder.name, CAMERA_TOPICS, CompressionType.ZSTD, METADATA, ATTACHMENTS, 10**9, 600 * NS_PER_S)
    series = Series(folder, form)
    noise = np.random.default_rng(1).normal(120, 3, (size_px[0] + 100, size_px[1])).astype(np.uint8)
    for number in range(count):
        time_ns = START_NS + number * FRAME_PERIOD_NS
        image = noise[number % 100 :][: size_px[0]]
        series.commit(
            make_frame_records(Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, number, time_ns)), time_ns
        )
    series.finish()
    write_telemetry(session, count // 2)


def _measure(session: Path, what: str) -> dict[str, float]:
    command = [sys.executable, "-m", __name__, str(session), what]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _region(path: Path) -> dict[str, float]:
    for package in ("xarray", "dask.array"):  # they are loaded by whoever uses them, before the time counts
        importlib.import_module(package)
    session = Session.open(path)
    base_MB = _peak_MB()
    begin_s = time.perf_counter()
    image = session.to_xarray()["camera"].image
    open_ms = 1e3 * (time.perf_counter() - begin_s)
    begin_s = time.perf_counter()
    region = image[:, 300:500, 500:700].compute()
    assert region.shape == (len(image), 200, 200)
    return {"s": time.perf_counter() - begin_s, "open_ms": open_ms, "MB": _peak_MB() - base_MB}


def _peak_MB() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _chunks(path: Path) -> dict[str, float]:
    session = Session.open(path)
    begin_s = time.perf_counter()
    count = 0
    for segment in session.frame_segments:
        for place in list_frame_places(segment):
            with segment.open("rb", buffering=0) as file:
                file.seek(place.chunk.offset)
                content = memoryview(file.read(place.chunk.length))[RECORD.size :]
            head = parse_chunk_head(content, len(content))
            count += len(zstandard.ZstdDecompressor().decompress(content[head.begin :], head.size_bytes)) > 0
    assert count == COUNT
    return {"s": time.perf_counter() - begin_s}


if __name__ == "__main__":
    sys.stdout.write(json.dumps({"region": _region, "chunks": _chunks}[sys.argv[2]](Path(sys.argv[1]))))
