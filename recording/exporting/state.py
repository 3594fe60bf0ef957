"""In which state the files of a session are that is exported: an export of a damaged or repaired one says so."""

from __future__ import annotations

from typing import NamedTuple

from thermostand.recording.reading.scan import summarise_findings
from thermostand.recording.reading.session import Session


class ExportedState(NamedTuple):
    """files: the word that `stand session list` has. findings: what is damaged, missing, repaired or rewritten, as
    lines; none of a session that is as it was recorded."""

    files: str
    findings: tuple[str, ...]

    @property
    def text(self) -> str:
        """The paragraph of a README."""
        if not self.findings:
            return "State    The files of the session were sound, and as they were recorded.\n"
        lines = "".join(f"         - {line}\n" for line in self.findings)
        return f"State    The files of the session were {self.files} when it was exported:\n{lines}"


def describe_state(session: Session) -> ExportedState:
    """The state of a session, by its records, steps and descriptions of frames."""
    return ExportedState(str(session.scanned.files), tuple(summarise_findings(session.scanned.findings)))
