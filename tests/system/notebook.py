"""The notebook of the tutorial, executed: `python -m tests.system.notebook SESSIONS` writes its outputs again, from the
folder that has `sessions` in it with the session of `stand run demo --virtual-time --seed 7`."""

from __future__ import annotations

import sys
from pathlib import Path

NOTEBOOK = Path(__file__).parents[2] / "docs" / "tutorials" / "simulated-session.ipynb"


def execute(folder: Path, *, writes: bool = False) -> list[str]:
    """The source of each cell of code, all of which have run in that folder. Raises where one fails."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    if writes:
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)  # when it ran
        nbformat.write(notebook, NOTEBOOK)
    return [cell.source for cell in notebook.cells if cell.cell_type == "code"]


if __name__ == "__main__":
    execute(Path(sys.argv[1]), writes=True)
