"""From a recorded session to its report: 3600 frames of 5 MP in PNG, with two workers; 450 also with one.

The session is written by the recorder's own series from a dozen rendered photographs, one for each temperature. The
peer looks for the same frames' circles with cv2.findCirclesGrid and its defaults: with as many workers over a part of
the frames, nothing else done, so that its rate is an upper limit of the same pipeline's.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import cv2
from mcap.writer import CompressionType

from tests.bench.figures import (
    Figure,
    compare,
    make_absolute,
    report_progress,
    set_lower_goal,
    set_lower_ratio_goal,
    set_upper_goal,
)
from tests.compensation.renderer import Scene, photograph, render
from tests.recording.device_declarations import declare_devices
from tests.recording.frame_records import CAMERA_TOPICS, make_frame_records
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import Batch, Item, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format.images import ZSTD_LEVEL, ImageArray
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.reading.session import Session
from thermostand.recording.writing.segment import SeriesSpec
from thermostand.recording.writing.series import Series
from thermostand.recording.writing.session_spec import list_telemetry_topics
from thermostand.recording.writing.telemetry import TelemetryEncoder
from thermostand.stand.config.stand_config import find_packaged

COUNT = 3600
FEW = 450  # an eighth
PEER_FRAMES = 120
WORKERS = 2
PERIOD_NS = NS_PER_S // 2
START_NS = 1_767_290_400 * NS_PER_S
SEQUENCE = (
    ("reference", 24.0),
    *(("fit", degC) for degC in (31.0, 45.0, 52.0, 38.0, 10.0, 17.0)),
    *(("validation", degC) for degC in (27.0, 41.0, 48.0, 13.0, 20.0)),
)
DEVICES = declare_devices({"thermometers": "thermometers", "camera": "camera"})
PEER = "cv2.findCirclesGrid, 2 workers, nothing else"


def figures(directory: Path) -> list[Figure]:
    """Seconds for the whole, frames per second beside the peer, and the memory for 450 and for 3600 frames."""
    sessions = {count: directory / f"pipeline-{count}" for count in (FEW, COUNT)}
    try:
        report_progress("pipeline, rendering and writing 8 GB")
        photographs = [render_photograph(index) for index in range(len(SEQUENCE))]
        for count, session in sessions.items():
            write_session(session, photographs, count)
        report_progress("pipeline, 450 frames to a report, with one worker and with two")
        alone, few = (_run_report(sessions[FEW], workers) for workers in (1, WORKERS))
        report_progress("pipeline, 3600 frames to a report")
        many = _run_report(sessions[COUNT], WORKERS)
        report_progress("pipeline, the peer")
        peer = _peer_frames_per_s(sessions[COUNT])
    finally:
        for session in sessions.values():
            shutil.rmtree(session, ignore_errors=True)
    own = COUNT / many.wall_s
    return [
        set_upper_goal(30, make_absolute("3600 frames of 5 MP to a report", "s", [many.wall_s])),
        set_lower_ratio_goal(10, compare("the same, detection, fit and report", "frames/s", PEER, [own], [peer])),
        set_lower_ratio_goal(
            1.8,
            compare("450 frames to a report", "frames/s", "1 worker", [FEW / few.wall_s], [FEW / alone.wall_s]),
        ),
        compare("  what of it is not shared out", "CPU s", "all with 1 worker", [few.cpu_s], [alone.cpu_s]),
        make_absolute("memory of its largest process", "MB", [many.peak_MB]),
        set_upper_goal(1.1, make_absolute("the same over that for 450 frames", "", [many.peak_MB / few.peak_MB])),
        set_lower_goal(1, make_absolute("report written", "", [float(many.written)])),
    ]


@dataclass(frozen=True)
class ReportCost:
    """cpu_s: of the program itself, without the processes that it shares the work out to."""

    wall_s: float
    cpu_s: float
    peak_MB: float
    written: bool


def _run_report(session: Path, workers: int) -> ReportCost:
    """The command, as a user calls it; its memory is that of the largest process below a fresh one."""
    out = session.with_suffix(".html")
    program = (
        "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL);"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN);"
        "print(used.ru_maxrss, used.ru_utime + used.ru_stime)"
    )
    command = [sys.executable, "-m", "thermostand.compensation.cli", "report", str(session), "-o", str(out)]
    begin_s = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", program, *command, "--workers", str(workers), "--no-cache"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    wall_s = time.perf_counter() - begin_s
    peak_KiB, cpu_s = done.stdout.split()
    return ReportCost(wall_s, float(cpu_s), int(peak_KiB) * 1024 / 1e6, out.stat().st_size > 0)


def _peer_frames_per_s(session: Path) -> float:
    """Its first frames, in equal parts; processes are started and warm before the time runs."""
    part = PEER_FRAMES // WORKERS
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        list(pool.map(_peer, [session] * WORKERS, range(WORKERS), range(1, WORKERS + 1)))
        begin_s = time.perf_counter()
        found = sum(
            pool.map(_peer, [session] * WORKERS, range(0, PEER_FRAMES, part), range(part, PEER_FRAMES + 1, part))
        )
        wall_s = time.perf_counter() - begin_s
    if found != PEER_FRAMES:
        raise RuntimeError(f"the peer found the target in {found} of {PEER_FRAMES} frames")
    return PEER_FRAMES / wall_s


def _peer(session: Path, first: int, end: int) -> int:
    cv2.setNumThreads(1)
    opened = Session.open(session)
    return sum(cv2.findCirclesGrid(opened.frame(number).image, (9, 6))[0] for number in range(first, end))


def render_photograph(index: int) -> ImageArray:
    """A photograph of the target, drifted by 0.009 and 0.026 px/K."""
    above_K = SEQUENCE[index][1] - 24
    scene = Scene(tilt_y_deg=3, roll_deg=1, shift_mm=(0.001 * above_K, 0.003 * above_K))
    return photograph(scene, render(scene), index)


def write_session(session: Path, photographs: list[ImageArray], count: int) -> None:
    metadata = {"session_id": session.name, "recipe": "pipeline", "camera_serial": "TS-0001", "simulated": "true"}
    attachments = {"target.yaml": find_packaged("targets", "paper-9x6").read_text(encoding="utf-8")}
    encoder = TelemetryEncoder(DEVICES)
    forms = [
        (FRAMES, CAMERA_TOPICS, CompressionType.ZSTD, 1_000_000_000),
        (TELEMETRY, list_telemetry_topics(DEVICES), CompressionType.ZSTD, 1_000_000_000),
    ]
    series: list[Series] = []
    for folder, topics, compression, size in forms:
        (session / folder).mkdir(parents=True)
        form = SeriesSpec(folder, topics, compression, metadata, attachments, size, 600 * NS_PER_S, level=ZSTD_LEVEL)
        series.append(Series(session / folder, form))
    frames, telemetry = series
    for number in range(count):
        time_ns = START_NS + number * PERIOD_NS
        index = number * len(SEQUENCE) // count
        degC = SEQUENCE[index][1] + 20
        frame = Frame("camera.image", photographs[index], time_ns, 0.1, 0.0, degC, number, time_ns, 0, f"step-{index}")
        frames.commit(make_frame_records(frame), time_ns)
        begins = number == 0 or index != (number - 1) * len(SEQUENCE) // count
        records = [record for item in _items(index, time_ns, begins) for record in encoder.encode(item)]
        telemetry.commit(records, time_ns)
    frames.finish()
    telemetry.finish()


def _items(index: int, time_ns: int, begins: bool) -> Iterator[Item]:
    role, chamber_degC = SEQUENCE[index]
    if begins:
        parameters: dict[str, object] = {"role": role, "chamber_degC": chamber_degC}
        yield StepMark(time_ns, f"step-{index}", index, "capture", StepState.STARTED, parameters)
    yield Batch("thermometers", time_ns, (Reading("thermometers.air", chamber_degC, "degC", time_ns),))
