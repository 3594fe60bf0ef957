"""Other laboratories' pictures and tables: what they show is found, and what they cannot show is stated."""

from __future__ import annotations

import csv
import json
import re
import shlex
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.compensation.other_laboratories import (
    PPM_PER_K,
    REFERENCE_DEGC,
    SHIFT_PX_PER_K,
    make_true_shift,
    write_picture,
    write_pose,
    write_target,
)
from thermostand.compensation.array_observations import load_observations
from thermostand.compensation.cli import app
from thermostand.compensation.drift.model_file import load_model

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "use-other-data.md"
TEMPERATURES = (10, 13, 16, 19, 22, 25, 28, 31, 34)
DISTANCES = (700, 800)
BEGIN = datetime(2026, 1, 8, 18, 0, 0, tzinfo=UTC)
WITH_TABLE = ("observe", "series", "--table", "log.csv", "--mapping", "m.yaml", "--target", "small.yaml")
PLACES = np.array([[60.0, 50.0], [160.0, 120.0], [250.0, 200.0]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`pictures/t25/p0700/0001.png`, two of each, with poses."""
    made = tmp_path_factory.mktemp("laboratory")
    write_target(made)
    for seed, (degC, distance_mm, number) in enumerate(
        (degC, distance_mm, number) for degC in TEMPERATURES for distance_mm in DISTANCES for number in (1, 2)
    ):
        path = made / "pictures" / f"t{degC}" / f"p{distance_mm:04}" / f"{number:04}.png"
        write_picture(path, degC, distance_mm, seed)
        write_pose(path.with_suffix(".txt"), distance_mm)
    return made


@pytest.fixture(scope="module")
def observed(folder: Path) -> dict[str, object]:
    """What `compensate observe` answers for that folder; the table is centres.csv."""
    return run(folder, "observe", "pictures", "--target", "small.yaml", "-o", "centres.csv")


def run(folder: Path, *arguments: str) -> dict[str, object]:
    """The JSON answer of `compensate`, run in a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = CliRunner().invoke(app, [*arguments, "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def refuse(folder: Path, *arguments: str) -> str:
    """The sentence that `compensate` refuses with."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = CliRunner().invoke(app, list(arguments))
    assert done.exit_code != 0, done.output
    assert "Traceback" not in done.output
    assert not (folder / "refused.csv").exists()
    return done.stderr


def check_model(path: Path) -> None:
    """The model corrects by what the camera was made to drift by."""
    model = load_model(path)
    for degC in (TEMPERATURES[0], REFERENCE_DEGC, TEMPERATURES[-1]):
        assert np.abs(model.shift(PLACES, float(degC)) - make_true_shift(PLACES, degC)).max() < 0.02


def write_german_table(folder: Path, pictures: Sequence[Path], *, air: bool = True) -> None:
    """A row for each picture, as Excel writes it in Germany: UTF-16, semicolons, decimal commas, an empty last row."""
    rows = [["Datei", "Zeitpunkt", "T Sensor [°C]", "Soll", "T Luft [°C]", "Zweck"]]
    for number, path in enumerate(pictures):
        degC = int(path.parts[-3][1:])
        time = (BEGIN + timedelta(minutes=2 * number)).strftime("%d.%m.%Y %H:%M:%S")
        role = "Referenz" if degC == REFERENCE_DEGC else "Messung"
        rows.append([path.name, time, f"{degC},0", f"{degC - 3}", f"{degC - 3},25" if air else "", role])
    rows.append([""] * 6)
    text = "sep=;\r\n" + "".join(";".join(row) + "\r\n" for row in rows)
    (folder / "werte.csv").write_bytes(text.encode("utf-16"))


def make_measurement(folder: Path, source: Path) -> list[Path]:
    """A folder `messung` of pictures with plain names, from those at 700 mm."""
    made = folder / "messung"
    made.mkdir()
    paths = sorted(source.glob("pictures/t*/p0700/*.png"))
    for number, path in enumerate(paths):
        (made / f"{number:03}.png").write_bytes(path.read_bytes())
    return paths


def test_pictures_with_the_temperature_in_their_names_give_a_model_a_report_and_a_datasheet(
    folder: Path, observed: dict[str, object]
):
    shown = observed
    assert shown["pictures"] == len(TEMPERATURES) * len(DISTANCES) * 2
    assert shown["sessions"] == ["centres p0700", "centres p0800"]
    assert shown["reference_degC"] == REFERENCE_DEGC
    assert shown["not_used"] == []
    assert shown["stated_poses"] == {"p0700": [0.0, 0.0], "p0800": [0.0, 0.0]}
    assert set(shown["not_known"]) == {"times", "air"}  # pyright: ignore[reportArgumentType]
    fitted = run(folder, "fit", "centres.csv", "-o", "model.json")
    assert fitted["form"] == "paper"
    assert set(fitted["not_known"]) == {"times", "air"}  # pyright: ignore[reportArgumentType]
    assert max(fitted["rms_after_px"]) < 0.01  # pyright: ignore[reportArgumentType]
    check_model(folder / "model.json")
    run(folder, "report", "centres.csv", "--model", "model.json", "-o", "report.html")
    assert "at unknown times" in (folder / "report.html").read_text()
    assert "1970" not in (folder / "report.html").read_text()
    run(folder, "datasheet", "centres.csv", "-o", "camera.json")
    sheet = json.loads((folder / "camera.json").read_text())
    assert sheet["air_degC"] == [None, None]
    assert sheet["recorded"] == []
    found = {one["key"]: one for one in sheet["quantities"]}
    for key, truth in (("shift_I_per_K", SHIFT_PX_PER_K), ("scale_per_K", PPM_PER_K)):
        assert abs(found[key]["value"] - truth) < 1.5 * found[key]["expanded_uncertainty"]
    assert found["self_heating_K"]["value"] is None
    assert found["camera_share"]["value"] is None


def test_the_layout_of_the_public_set_is_read_with_its_index(folder: Path, tmp_path: Path):
    """000000_t10_p0700_color.png beside depth pictures, and an index.csv with blanks between its cells."""
    made = tmp_path / "set"
    made.mkdir()
    rows = ["Name Type Temp position"]
    for number, path in enumerate(sorted(folder.glob("pictures/t*/p*/*.png"))):
        degC, place = path.parts[-3], path.parts[-2]
        name = f"{number:06}_{degC}_{place}"
        (made / f"{name}_color.png").write_bytes(path.read_bytes())
        (made / f"{name}_depth.png").write_bytes(b"not looked at")
        (made / f"{name}_sdepth.txt").write_bytes(path.with_suffix(".txt").read_bytes())
        rows += [f"{name}_color.png  color {degC[1:]} {place[1:]}", f"{name}_depth.png  depth {degC[1:]} {place[1:]}"]
    (made / "index.csv").write_text("\n".join(rows) + "\n")
    write_target(tmp_path)
    shown = run(tmp_path, "observe", "set", "--target", "small.yaml", "-o", "centres.csv")
    assert shown["pictures"] == len(TEMPERATURES) * len(DISTANCES) * 2
    assert shown["sessions"] == ["centres p0700", "centres p0800"]
    assert shown["stated_poses"] == {"p0700": [0.0, 0.0], "p0800": [0.0, 0.0]}
    (made / "index.csv").write_text("\n".join(rows).replace("color 10 ", "color 25 ") + "\n")
    text = refuse(tmp_path, "observe", "set", "--target", "small.yaml", "-o", "refused.csv")
    assert "index.csv: line 2:" in text
    assert "10 degC by its name, and at 25" in text


def test_pictures_and_a_german_table_with_a_mapping(folder: Path, tmp_path: Path):
    paths = make_measurement(tmp_path, folder)
    renamed = [path.parent / f"{number:03}.png" for number, path in enumerate(paths)]
    write_german_table(tmp_path / "messung", renamed)
    write_target(tmp_path)
    (tmp_path / "messung.yaml").write_text(find_blocks("yaml")[0])
    shown = run(
        tmp_path, "observe", "messung", "--mapping", "messung.yaml", "--target", "small.yaml", "-o", "centres.csv"
    )
    assert shown["pictures"] == len(paths)
    assert set(shown["not_known"]) == {"supply"}  # pyright: ignore[reportArgumentType]
    found = load_observations(tmp_path / "centres.csv")
    assert found.image_size == (320, 256)
    assert found.role.tolist() == ["reference" if p.parts[-3] == f"t{REFERENCE_DEGC}" else "fit" for p in paths]
    assert found.chamber_degC.tolist() == [int(path.parts[-3][1:]) - 3 for path in paths]
    assert found.air_degC.tolist() == [int(path.parts[-3][1:]) - 2.75 for path in paths]
    assert found.time_ns[0] == int(BEGIN.timestamp()) * 10**9
    assert set(np.diff(found.time_ns)) == {120 * 10**9}
    run(tmp_path, "fit", "centres.csv", "--form", "paper", "-o", "model.json")
    check_model(tmp_path / "model.json")


def test_pictures_take_from_a_log_what_it_says_at_their_time(folder: Path, tmp_path: Path):
    made = tmp_path / "series"
    made.mkdir()
    paths = sorted(folder.glob("pictures/t*/p0700/*.png"))
    log = ["when,sensor,air"]
    for number, path in enumerate(paths):
        at, degC = BEGIN + timedelta(minutes=number), int(path.parts[-3][1:])
        (made / f"{at:%Y%m%dT%H%M%S}.png").write_bytes(path.read_bytes())
        log += [f"{(at + timedelta(seconds=s)).timestamp()},{degC + s / 100},{degC - 3}" for s in (-10, 10)]
    (tmp_path / "log.csv").write_text("\n".join(log) + "\n")
    write_target(tmp_path)
    (tmp_path / "m.yaml").write_text(
        "columns: {time: when, camera_degC: sensor, air_degC: air}\ntime_unit: s\ntime_in_name: '%Y%m%dT%H%M%S'\n"
    )
    run(tmp_path, *WITH_TABLE, "-o", "c.csv")
    found = load_observations(tmp_path / "c.csv")
    assert found.camera_degC.tolist() == [int(path.parts[-3][1:]) for path in paths]
    (history,) = found.histories
    assert len(history.ambient_ns) == 3 * len(paths)  # the frames', and two readings about each
    (tmp_path / "m.yaml").write_text("columns: {time: when, camera_degC: sensor}\ntime_unit: s\n")
    text = refuse(tmp_path, *WITH_TABLE, "-o", "refused.csv")
    assert "time_in_name" in text


@pytest.mark.parametrize("moved", ["one place is another", "no place is seen twice"])
def test_a_target_that_was_moved_is_not_taken_for_drift(moved: str, tmp_path: Path):
    write_target(tmp_path)
    for seed, degC in enumerate(TEMPERATURES):
        distance_mm = 650 + 40 * seed if moved == "no place is seen twice" else 800 if degC == 34 else 700
        write_picture(tmp_path / "pictures" / f"t{degC}" / f"{seed}.png", degC, distance_mm, seed)
    arguments = ("observe", "pictures", "--target", "small.yaml", "-o", "refused.csv")
    if moved == "no place is seen twice":
        assert "no place of the target was seen at the reference and at another" in refuse(tmp_path, *arguments)
        return
    shown = run(tmp_path, *arguments)
    found = load_observations(tmp_path / "refused.csv")
    assert shown["sessions"] == ["refused place-1", "refused place-2"]
    assert found.role.tolist().count("other") == 1


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda at: (at / "pictures").mkdir(), "has no pictures"),
        (lambda at: (at / "pictures").write_bytes(b"PK"), "not a folder"),
        (lambda at: write_picture(at / "pictures" / "t10" / "t20.png", 10, 700, 1), "several temperatures: 10, 20"),
        (lambda at: write_picture(at / "pictures" / "a.png", 10, 700, 1), "its camera temperature is not known"),
        (lambda at: write_picture(at / "pictures" / "t10" / "a.png", 10, 700, 1), "at the reference and at another"),
        (lambda at: write_bad_pose(at), "p.txt: not a 4x4 pose"),
    ],
)
def test_what_cannot_be_observed_is_refused_with_a_sentence(make, says: str, tmp_path: Path):
    write_target(tmp_path)
    make(tmp_path)
    assert says in refuse(tmp_path, "observe", "pictures", "--target", "small.yaml", "-o", "refused.csv")
    assert "--target" in refuse(tmp_path, "observe", ".", "-o", "refused.csv")


def write_bad_pose(at: Path) -> None:
    for degC in (10, 12, 14):
        write_picture(at / "pictures" / f"t{degC}" / "p.png", degC, 700, degC)
    (at / "pictures" / "t10" / "p.txt").write_text("1 0 0\n0 1 0\n")


def find_blocks(language: str) -> list[str]:
    """The blocks of this language on the how-to page."""
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.usefixtures("observed")
def test_the_page_does_what_it_says_and_workers_find_the_same_table(folder: Path, tmp_path: Path):
    (tmp_path / "pictures").symlink_to(folder / "pictures")
    paths = make_measurement(tmp_path, folder)
    write_german_table(
        tmp_path / "messung", [p.parent / f"{number:03}.png" for number, p in enumerate(paths)], air=False
    )
    write_target(tmp_path)
    for block in find_blocks("yaml"):
        (tmp_path / block.splitlines()[0].removeprefix("# ")).write_text(block)
    commands = [line for block in find_blocks("console") for line in block.splitlines()]
    assert len(commands) == 8
    for line in commands:
        if "others.txt" in line:
            write_other_table(tmp_path / "centres.csv", tmp_path / "others.txt")
        run(tmp_path, *shlex.split(line)[1:])
    assert (tmp_path / "centres.csv").read_bytes() == (folder / "centres.csv").read_bytes()
    for name in ("model.json", "messung.json", "others.json"):
        check_model(tmp_path / name)
    assert (tmp_path / "report.html").stat().st_size > 10_000


def write_other_table(source: Path, out: Path) -> None:
    """The centres of one session with other names, decimal commas and tabs."""
    names = {"frame": "Bild", "marker": "Punkt", "x_px": "X", "y_px": "Y", "camera_degC": "Temperatur"}
    with source.open(newline="") as file, out.open("w", newline="") as other:
        writer = csv.writer(other, delimiter="\t")
        writer.writerow(names.values())
        rows = [row for row in csv.DictReader(file) if row["session"] == "p0700"]
        middle = [row for row in rows if row["camera_degC"].startswith(str(REFERENCE_DEGC))]
        rest = [row for row in rows if row not in middle]  # without roles the first temperature is the reference
        for row in [*middle, *rest]:
            frame = int(row["frame"]) + (0 if row in middle else 1000)
            writer.writerow([f"{frame}.0", *(row[name].replace(".", ",") for name in list(names)[1:])])
