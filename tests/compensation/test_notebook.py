"""The tutorial's notebook runs from its first cell to its last, on a small session."""

import json
from pathlib import Path

import pytest

from tests.system.notebook import NOTEBOOK, execute

from .conftest import Recorded


@pytest.mark.usefixtures("undrawn")
def test_the_notebook_runs_on_a_recorded_session(recorded: Recorded, tmp_path: Path):
    (tmp_path / "sessions").mkdir()
    (tmp_path / "sessions" / "small-demo").symlink_to(recorded.path)
    assert len(execute(tmp_path)) == 6


def test_the_notebook_is_shown_with_what_its_cells_have_given():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert all(cell["outputs"] for cell in cells if cell["cell_type"] == "code")
