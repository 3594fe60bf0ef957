"""Entries of a stand's file that a test changes, by section; `camera` is the leading one."""

from typing import Any


def change(data: dict[str, Any], sections: dict[str, Any]) -> None:
    """Each section's entries over those in `data`."""
    for name, entries in sections.items():
        (data["cameras"]["camera"] if name == "camera" else data.setdefault(name, {})).update(entries)
