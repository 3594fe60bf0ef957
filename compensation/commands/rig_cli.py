"""`compensate calibrate-rig`: cameras fixed to each other, from pictures of one board at the same moments."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from thermostand.compensation.calibration.exports import EXPORTS, write_exports
from thermostand.compensation.calibration.pinhole import NAMES
from thermostand.compensation.calibration.rig import RigCalibration, calibrate_rig
from thermostand.compensation.commands.options import MegapixelsOption, finding_markers, say_left_out
from thermostand.compensation.commands.photographs_cli import described, known_board, views_of
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import check_folder_writable, make_folder, write_whole
from thermostand.foundation.image_limit import GREATEST_MEGAPIXELS, images_up_to
from thermostand.foundation.output import show
from thermostand.foundation.progress import Report

app = App()

RIG = "rig.json"


@app.command("calibrate-rig")
def calibrate_rig_command(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="FOLDER...", help="A folder of pictures for each camera, the first one first."),
    ],
    target: Annotated[str, typer.Option("--target", help="A target file or an installed name, as for photographs.")],
    export: Annotated[
        Path, typer.Option(help="A folder, new or not: rig.json, and a folder of files for each camera.")
    ],
    max_megapixels: MegapixelsOption = GREATEST_MEGAPIXELS,
) -> None:
    """Calibrate cameras that are fixed to each other: lenses, and each camera's pose against the first one.

    Pictures of one moment have the same name in all folders; a camera that does not see the target may lack some. Hold
    the target still for each moment, tilted by 20 to 40 deg to all sides, at least three times where a camera and the
    first one both see it. A point X of the first camera's frame is at R X + t in another one's (rig.json, mm).

    Example: compensate calibrate-rig left right --target my-target.yaml --export rig
    """
    with images_up_to(max_megapixels):
        if len(folders) < 2 or len({folder.name for folder in folders}) < len(folders):
            raise ConfigError("a rig has two or more cameras, each with a folder of another name")
        check_folder_writable(export, [RIG])
        for folder in folders:
            check_folder_writable(export / folder.name, EXPORTS)
        board = described(target)
        names = _moments(folders)
        failures: list[str] = []
        doubtful: list[str] = []
        with finding_markers(len(folders) * len(names)) as report:
            seen = [
                views_of(_pictures(folder, names), board, failures, doubtful, _after(report, number * len(names)))
                for number, folder in enumerate(folders)
            ]
        say_left_out("not used:", failures, doubtful)
        useful = np.any([views.seen.any(axis=1) for views in seen], axis=0)
        found = calibrate_rig([views.part(useful) for views in seen], known_board(board))
        lines = [
            f"{np.count_nonzero(useful)} moments, {len(folders)} cameras",
            *_lines(found, folders),
            board.orientation,
        ]
        data = _written(found, folders, export)
        show({"cameras": data, "not_used": failures, "doubtful": doubtful, "exports": export}, lines)


def _moments(folders: list[Path]) -> list[str]:
    """The names of the pictures, those of all folders together."""
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"{folder}: not a folder")
    names = sorted({path.name for folder in folders for path in folder.iterdir() if path.is_file()})
    if not names:
        raise ConfigError(f"{folders[0]}: there are no pictures")
    return names


def _after(report: Report, before: int) -> Report:
    def later(done: float, text: str) -> None:
        report(before + done, text)

    return later


def _pictures(folder: Path, names: list[str]) -> list[tuple[Path | None, str]]:
    """Of each moment, None where the folder has none."""
    return [(folder / name if (folder / name).exists() else None, f"{folder.name}/{name}") for name in names]


def _written(found: RigCalibration, folders: list[Path], export: Path) -> list[dict[str, object]]:
    """Write rig.json and each camera's files; what rig.json says."""
    data = _data(found, folders)
    make_folder(export)
    for number, folder in enumerate(folders):
        write_exports(export / folder.name, found.scene.lenses[number], folder.name, found.rms_px(number))
    write_whole(export / RIG, json.dumps(data, indent=1) + "\n")
    return data


def _data(found: RigCalibration, folders: list[Path]) -> list[dict[str, object]]:
    """The cameras as rig.json has them."""
    rows: list[dict[str, object]] = []
    for number, folder in enumerate(folders):
        lens = found.scene.lenses[number]
        row: dict[str, object] = {
            "name": folder.name,
            "image_size": list(lens.image_size),
            "lens": dict(zip(NAMES, lens.vector.tolist(), strict=False)),
            "lens_sigma": dict(zip(NAMES, found.lens_sigma(number).tolist(), strict=False)),
            "rotation": found.scene.rotations[number].tolist(),
            "translation_mm": found.scene.translations_mm[number].tolist(),
            "rms_px": found.rms_px(number),
            "discrepancy_px": float(found.discrepancies_px[number]),
        }
        if number > 0:
            turn_deg, shift_mm = found.pose_sigma(number)
            row |= {"rotation_sigma_deg": turn_deg.tolist(), "translation_sigma_mm": shift_mm.tolist()}
        rows.append(row)
    return rows


def _lines(found: RigCalibration, folders: list[Path]) -> list[str]:
    lines: list[str] = []
    for number, folder in enumerate(folders):
        lens = found.scene.lenses[number]
        line = (
            f"{folder.name}: fx {lens.vector[0]:.2f} +- {found.lens_sigma(number)[0]:.2g} px, residual "
            f"{1e3 * found.rms_px(number):.1f} mpx per coordinate, discrepancy "
            f"{1e3 * found.discrepancies_px[number]:.1f} mpx"
        )
        if number > 0:
            length, sigma = found.baseline_mm(number)
            turn_deg = float(np.degrees(np.arccos(np.clip((np.trace(found.scene.rotations[number]) - 1) / 2, -1, 1))))
            line += (
                f"; {length:.3f} mm +- {2 * sigma:.2g} (k = 2) from {folders[0].name}, turned by {turn_deg:.3f} deg +- "
                f"{2 * found.pose_sigma(number)[0].max():.2g} (k = 2)"
            )
        lines.append(line)
    return lines
