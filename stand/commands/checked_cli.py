"""Warnings about a stand's last `stand check`: that there was none, or that it was of another file."""

from __future__ import annotations

from pathlib import Path

from thermostand.foundation.documents import read_document
from thermostand.foundation.output import say
from thermostand.stand.config.check_record import CheckRecord, explain_unchecked
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.order import read_register_texts


def warn_unchecked(path: Path, stand: StandConfig, record: CheckRecord | None) -> None:
    """A sentence on standard error when the stand at `path` should be checked before it is relied upon."""
    texts = {"config.yaml": read_document(path), **read_register_texts(stand)}
    if found := explain_unchecked(path, record, texts, is_simulated=stand.simulation is not None):
        say(f"warning: {found}")
