"""What `make demo` does after its run: fit, validate, report."""

from __future__ import annotations

from pathlib import Path

from compensation.drift.validation import table
from compensation.report.report import analyse
from stand.progress import progress


def run_demo(session: Path, out: Path) -> list[str]:
    """Fit and report a session; the lines to show: the table beside the paper's and where the report is."""
    report = out / "report.html"
    evaluation = analyse([session], out / "model.json", report, progress)
    return [table(evaluation), f"session  {session}", f"model    {out / 'model.json'}", f"report   {report}"]
