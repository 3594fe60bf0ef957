"""Reads the record that `stand check` keeps next to a stand's file: does it belong to this version of the file?"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from thermostand.foundation.documents import read_document
from thermostand.foundation.errors import ConfigError

ATTACHMENT = "commissioning.json"  # its name in a session


@dataclass(frozen=True, slots=True)
class CheckRecord:
    """text: the whole record, JSON. at: when it was begun. digests: of the texts it was made of. failed: how many
    things were wrong; moved: whether it was made with moves."""

    text: str
    at: datetime
    digests: Mapping[str, str]
    failed: int
    moved: bool


def get_record_files(config: Path) -> tuple[Path, Path]:
    """Return where the record of a stand's file is kept: JSON, and HTML for people."""
    return config.with_name(f"{config.stem}.check.json"), config.with_name(f"{config.stem}.check.html")


def compute_digest(text: str) -> str:
    """Compute the digest of one text."""
    return hashlib.sha256(text.encode()).hexdigest()


def load_check_record(config: Path) -> CheckRecord | None:
    """The record next to the file, None when there is none; ConfigError when it cannot be read or is none."""
    path, _ = get_record_files(config)
    if not path.is_file():
        return None
    text = read_document(path)
    try:
        known: dict[str, Any] = json.loads(text)
        failed = sum(finding["verdict"] == "failed" for finding in known["findings"])
        return CheckRecord(text, datetime.fromisoformat(known["began"]), known["digests"], failed, bool(known["moves"]))
    except (ValueError, LookupError, TypeError) as error:
        raise ConfigError(f"{path}: is no record of `stand check`; remove it and check again") from error


def explain_unchecked(config: Path, record: CheckRecord | None, texts: Mapping[str, str], *, is_simulated: bool) -> str:
    """Return why a stand should be checked before it is relied upon, as a sentence; "" when it need not be. texts: its
    file and register maps as they are now, by the names under which sessions have them."""
    again = f"`stand check --config {config}`"
    if record is None:
        return "" if is_simulated else f"{config} was never checked on this stand; {again} does it"
    at = f"{record.at.astimezone():%Y-%m-%d %H:%M}"
    if changed := sorted(name for name, text in texts.items() if record.digests.get(name) != compute_digest(text)):
        maps = [name for name in changed if name != "config.yaml"]
        named = " and ".join([*([str(config)] if len(maps) < len(changed) else []), *maps])
        return f"{named} {'has' if len(changed) == 1 else 'have'} changed since the check of {at}; {again} looks again"
    if record.failed:
        things = "1 thing was" if record.failed == 1 else f"{record.failed} things were"
        return f"{config}: {things} wrong at the check of {at}; {again} looks again"
    return ""
