"""mrcal beside ours, as a process of the Python that it is installed for (Debian: python3-mrcal).

mrcal knows regular boards only, and no table: both get a print without error, by its nominal numbers, and the table's
axes come from each one's own poses of the calibration positions.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.bench.figures import Figure, compare, make_skipped, report_progress
from tests.compensation.calibration_truth import SIZE, CENTRE_mm, Truth, board, draw, positions, translation_errors_um
from thermostand.compensation.calibration.adjustment import adjust, fit_table
from thermostand.compensation.calibration.board import compute_homography_shifts
from thermostand.compensation.calibration.pinhole import Pinhole, calibrate_opencv
from thermostand.compensation.calibration.stage_geometry import TableSigma

PYTHON = "/usr/bin/python3"
SEEDS = range(6)
TABLE = TableSigma(linear_mm=0.0005, rotary_arcmin=0.1)
PEER = "mrcal, OPENCV5, board warp"
_ROWS, _COLUMNS, _SPACING_M = 6, 9, 0.030
_MM = 1e3
_LIMIT_S = 60.0

Float = NDArray[np.float64]


def figures() -> list[Figure]:
    """Translations of V0..V3, um RMS over six laboratories with an exact print; one skipped line without mrcal."""
    if not is_installed():
        return [make_skipped("calibration, mrcal", f"{PYTHON} has no mrcal (Debian: python3-mrcal)")]
    report_progress("calibration, mrcal")
    pairs = [_errors_um(seed) for seed in SEEDS]
    ours, theirs = (_rms([pair[which] for pair in pairs]) for which in (0, 1))
    return [
        compare(f"calibration, V0..V3 along {axis}, exact print", "um RMS", PEER, [own], [other])
        for axis, own, other in zip("XYZ", ours, theirs, strict=True)
    ]


def is_installed() -> bool:
    """Whether that Python can import it."""
    try:
        return subprocess.run([PYTHON, "-c", "import mrcal"], capture_output=True, timeout=_LIMIT_S).returncode == 0
    except OSError:
        return False


def _errors_um(seed: int) -> tuple[Float, Float]:
    """(3, 3) each: ours and mrcal's of V1..V3 from V0."""
    laboratory = draw(Truth(seed=seed, printing_mm=0.0))
    seen, known = positions(laboratory), board(laboratory, measured=False)
    own = adjust(seen, known, TABLE)
    ours = translation_errors_um(laboratory, own.scene.lens, own.adjusted_board, own.scene.table)
    shifts = [compute_homography_shifts(centres, known.points_mm, known.diameters_mm) for centres in seen.centres_px]
    lens, rotations, translations_mm = calibrated(seen.centres_px - np.array(shifts), known.points_mm)
    table = fit_table(seen.linear_mm, seen.rotary_deg, rotations, translations_mm, CENTRE_mm)
    return ours, translation_errors_um(laboratory, lens, known, table)


def calibrated(centres_px: Float, points_mm: Float) -> tuple[Pinhole, Float, Float]:
    """mrcal's lens, rotations (P, 3, 3) and translations (P, 3), mm, from centres (P, 54, 2); it starts at OpenCV's."""
    begin = calibrate_opencv(centres_px, points_mm, SIZE)
    turns = Rotation.from_matrix(begin.rotations).as_rotvec()
    given = {
        "centres_px": centres_px.reshape(-1, _ROWS, _COLUMNS, 2),
        "spacing_m": np.array(_SPACING_M),
        "size_px": np.array(SIZE),
        "intrinsics": begin.lens.vector,
        "poses": np.concatenate([turns, begin.translations_mm / _MM], axis=1),
    }
    with tempfile.TemporaryDirectory(prefix="mrcal-") as folder:
        into, out = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(into, allow_pickle=False, **given)
        command = [PYTHON, str(Path(__file__).with_name("mrcal_process.py")), str(into), str(out)]
        subprocess.run(command, check=True, capture_output=True, timeout=_LIMIT_S)
        with np.load(out) as found:
            poses, vector = found["poses"], found["intrinsics"]
    return Pinhole(vector, SIZE), Rotation.from_rotvec(poses[:, :3]).as_matrix(), _MM * poses[:, 3:]


def _rms(errors: Sequence[Float]) -> list[float]:
    return np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)).tolist()
