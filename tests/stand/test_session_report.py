"""What `stand run --report` says of a session beside its table: steps of the image and slips, from the numbers."""

from __future__ import annotations

import json

import pytest

from thermostand.compensation.observations import MixedEquilibria
from thermostand.compensation.reporting import report
from thermostand.stand.running.session_report import NotReported, report_session

MOVED = "the image moved by +30 (1) mpx along I and -40 (1) along J (standard uncertainty)"


def test_a_step_and_slips_are_reported_when_the_session_is_reported(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    bump = {"after": "2026-01-02T06:00:00Z", "before": "2026-01-02T06:40:00Z", "text": MOVED}
    kinds = [{"cause": "slips", "text": "a joint slips"}, {"cause": "nothing", "text": "all repeats"}]

    def analysed(_sessions: object, _model: object, page: object, _progress: object) -> None:
        assert page == tmp_path / "report.html"
        (tmp_path / "report.json").write_text(json.dumps({"bumps": [bump], "unrepeated": kinds}))

    monkeypatch.setattr(report, "analyse", analysed)
    lines = report_session(tmp_path / "cycle", tmp_path).lines
    assert lines == [
        f"warning: between 2026-01-02T06:00:00Z and 2026-01-02T06:40:00Z {MOVED}; no temperature explains it",
        "warning: a joint slips",
        f"report   {tmp_path / 'report.html'}",
    ]


def test_a_session_across_a_gap_is_reported_by_hand_with_the_option_that_allows_it(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise MixedEquilibria("its frames are of two equilibria")

    monkeypatch.setattr(report, "analyse", refused)
    with pytest.raises(NotReported, match=r"cycle --across-gap -o report\.html` tries again$"):
        report_session(tmp_path / "cycle", tmp_path)
