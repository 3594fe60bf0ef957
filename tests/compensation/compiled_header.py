"""An exported C header, compiled with all warnings and sanitizers, and what it says of samples and points."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wshadow", "-Wconversion", "-Wdouble-promotion")
_SANITIZED = ("-fsanitize=address,undefined,float-divide-by-zero,float-cast-overflow", "-fno-sanitize-recover=all")
_PROGRAM = Path(__file__).with_name("header_program.c")


@dataclass(frozen=True, eq=False)
class HeaderOutput:
    """After each of S samples: flags of the state (S,), corrected points (S, N, 2), their flags (S, N), displacements
    in single precision (S, N, 2); and the maps (2, height, width) after the last one."""

    state_flags: Float
    corrected_px: Float
    flags: Float
    shift_f32_px: Float
    maps: NDArray[np.float32]


def compile_header(header: Path, *, sanitized: bool = True) -> Path:
    """The program beside the header, which is called drift.h."""
    assert COMPILER is not None
    program = header.with_name("program")
    flags = [*STRICT, "-O1", *(_SANITIZED if sanitized else ())]
    subprocess.run([COMPILER, *flags, f"-I{header.parent}", _PROGRAM, "-o", program, "-lm"], check=True)
    return program


def run_header(program: Path, points_px: Float, samples: Float, size: tuple[int, int]) -> HeaderOutput:
    given = np.concatenate([[float(len(points_px))], points_px.ravel(), samples.ravel()])
    maps = program.with_name("maps")
    done = subprocess.run([program, maps], input=given.tobytes(), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    count = len(points_px)
    rows = np.frombuffer(done.stdout).reshape(len(samples), 1 + 5 * count)
    state, corrected, flags, shift = np.split(rows, [1, 1 + 2 * count, 1 + 3 * count], axis=1)
    shape = (len(samples), count, 2)
    return HeaderOutput(
        state[:, 0],
        corrected.reshape(shape),
        flags,
        shift.reshape(shape),
        np.fromfile(maps, np.float32).reshape(2, size[1], size[0]),
    )
