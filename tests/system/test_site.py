"""The documentation as a site: every link within it is there, and no page asks another server for anything."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from thermostand.foundation.schemas import make_schema
from thermostand.stand.config.stand_config import StandConfig

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore", "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_each_page_is_made(site: Path):
    pages = {str(path.relative_to(site)) for path in site.rglob("*.html")}
    written = {str(path.relative_to(ROOT / "docs").with_suffix(".html")) for path in (ROOT / "docs").rglob("*.md")}
    assert {path for path in written if not path.startswith("examples/")} <= pages
    assert {f"reference/{name}.html" for name in ("stand-file", "recipe-file", "register-map", "target-file")} <= pages


@pytest.mark.parametrize(
    ("page", "entries"),
    [
        ("reference/steps.html", ("soak_until_settled", "band_K")),
        ("reference/events.html", ("guard.over_temperature", "soak_longer")),
        ("reference/cli-stand.html", ("stand session verify", "--virtual-time")),
        ("reference/cli-compensate.html", ("compensate calibrate-rig", "--like")),
        ("reference/model-file.html", ("leverage_matrix_px2", "between_sessions_px")),
        ("reference/python-api.html", ("thermostand.compensation.fit", "centres_px")),
    ],
)
def test_a_reference_that_is_made_has_what_the_program_has(site: Path, page: str, entries: tuple[str, ...]):
    text = (site / page).read_text(encoding="utf-8")
    assert "<!-- made:" not in text
    assert [entry for entry in entries if entry not in text] == []


def test_the_files_of_the_architecture_exist():
    rows = re.findall(r"^\| `([^`]+\.py)`", (ROOT / "docs/architecture.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(rows) == 12
    assert [row for row in rows if not (ROOT / row).is_file()] == []


def test_each_device_of_the_hardware_status_has_its_source_and_tests():
    """Pages and sections that the table names stand in the device's own file, and its tests exist."""
    text = (ROOT / "docs/explanation/hardware-status.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in text.splitlines() if row.startswith("| ")][
        1:
    ]
    assert len(rows) == 22
    for device, read, _, _, _, file, tests in rows:
        (home,) = (
            [ROOT / "configs" / file.strip("`")] if "/" in file else (ROOT / "drivers/devices").rglob(file.strip("`"))
        )
        source = home.read_text(encoding="utf-8")
        assert [
            number for number in re.findall(r"p\. ([\d-]+)|\b(\d-\d)\b", read) if max(number) not in source
        ] == [], device
        assert (ROOT / "tests" / f"{tests.strip('`')}.py").is_file(), device


def test_no_page_loads_anything_from_elsewhere(site: Path):
    loads = re.compile(
        r"""<(?:script|img|iframe)[^>]+src="(https?:)?//|<link[^>]+rel="stylesheet"[^>]+href="(https?:)?//"""
    )
    assert [path.name for path in site.rglob("*.html") if loads.search(path.read_text(encoding="utf-8"))] == []


def test_the_reference_has_every_key_with_its_bounds(site: Path):
    page = (site / "reference/stand-file.html").read_text(encoding="utf-8")
    rows = [re.sub(r"<[^>]+>", " ", row).split() for row in re.findall(r"<tr>(.*?)</tr>", page, re.DOTALL)]
    assert {row[0] for row in rows if row} >= make_schema(StandConfig)["properties"].keys()
    assert ["after_s", "number", "&gt;=", "0,", "&lt;=", "60", "0.0"] in rows
    assert ["fault_when", "open", "or", "closed", "open"] in rows
    assert 'id="guardconfig"' in page
