"""An exported C header on one core: points, map updates of a 5 MP camera, samples of the thermal state."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

from tests.bench.figures import Figure, compare, make_absolute, make_skipped, report_progress, set_upper_goal
from tests.compensation.compiled_header import COMPILER
from tests.compensation.made_up_models import paper, thermal
from thermostand.compensation.apply.runtime_export import export_c
from thermostand.compensation.drift.paper_model import PaperModel
from thermostand.compensation.drift.thermal_model import ThermalModel

SIZE = (2448, 2048)
_PROGRAM = Path(__file__).with_name("c_header.c")


def figures(directory: Path) -> list[Figure]:
    """ns per point and sample, ms per map; the best of 25 rounds."""
    if COMPILER is None:
        return [make_skipped("a point corrected in C", "no C compiler here")]
    found: list[Figure] = []
    for model in (thermal(), paper(4)):
        report_progress(f"C header, {model.form} form")
        point_ns, strips_ms, map_ms, memory_ms, sample_ns = _measure(model, directory)
        name = f"C header, {model.form} form"
        found += [
            set_upper_goal(1000, make_absolute(f"{name}: a point with its flags", "ns", [point_ns])),
            set_upper_goal(2, make_absolute("  maps of 5 MP, in strips of 32 rows", "ms", [strips_ms])),
            compare("  maps of 5 MP, whole: 40 MB", "ms", "memset of 40 MB", [map_ms], [memory_ms]),
            make_absolute("  a sample of the thermal state", "ns", [sample_ns]),
        ]
    return found


def _measure(model: ThermalModel | PaperModel, directory: Path) -> list[float]:
    folder = directory / model.form
    folder.mkdir()
    export_c(replace(model, facts=replace(model.facts, image_size=SIZE)), folder / "drift.h")
    program = folder / "timed"
    flags = ["-std=c99", "-O3", "-march=native", f"-I{folder}"]
    subprocess.run([str(COMPILER), *flags, _PROGRAM, "-o", program, "-lm"], check=True)
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    return [float(word) for word in done.stdout.split()]
