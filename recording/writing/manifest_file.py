"""The manifest of a session under way, and of one that a killed recorder has left.

Who finishes a segment waits for no other that writes: the two series have a thread each, and one of them may hang in
the disk. What a disk refuses is written with the next change.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Lock

from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import replace_file
from thermostand.recording.format.damage import convert_damage
from thermostand.recording.format.inventory import SegmentFile, SegmentState, list_segments
from thermostand.recording.format.journal_lines import JOURNAL_NAME, hash_text
from thermostand.recording.format.layout import UNFINISHED
from thermostand.recording.format.manifest import (
    MANIFEST_NAME,
    Manifest,
    NoManifest,
    Sealed,
    digest_journal,
    read_manifest,
)
from thermostand.recording.format.mcap_contents import read_contents
from thermostand.recording.format.records import Head, read_head


class ManifestFile:
    """`session.json` of the session in `directory`, which is begun, or continued where that has one; OSError when it
    cannot be written now. Methods may be called by any thread, and raise nothing."""

    def __init__(self, directory: Path, begun: Manifest) -> None:
        self._directory = directory
        before = read_manifest(directory)
        if isinstance(before, Manifest) and dict(before.session) == dict(begun.session):
            begun = replace(before, devices={**before.devices, **begun.devices}, ended=False, journal=None)
        elif _list_finished(directory):
            begun = replace(begun, remade=True)
        self._manifest = _add_segments(directory, begun)
        self._changing, self._writing = Lock(), Lock()
        self._is_new = False
        replace_file(directory / MANIFEST_NAME, self._manifest.encode())

    def seal(self, name: str, sealed: Sealed) -> None:
        """A segment has been finished."""
        with self._changing:
            self._manifest, self._is_new = self._manifest.add_segment(name, sealed), True
        self._write()

    def plan(self, size: Mapping[str, int]) -> None:
        """State how many `steps` and `frames` the plan has from now on."""
        with self._changing:
            self._manifest, self._is_new = replace(self._manifest, plan=dict(size)), True
        self._write()

    def end(self) -> None:
        """Record nothing any more. With a segment that could not be finished it is no end."""
        with suppress(OSError):
            if any(self._directory.glob(f"*/*{UNFINISHED}")):
                return
            journal = self._directory / JOURNAL_NAME
            so_far = digest_journal(journal.read_bytes()) if journal.is_file() else None
            with self._changing:
                self._manifest, self._is_new = replace(self._manifest, ended=True, journal=so_far), True
            self._write()

    def _write(self) -> None:
        """Unless another thread does, which then writes once more."""
        while self._is_new and self._writing.acquire(blocking=False):
            try:
                with self._changing:
                    manifest, self._is_new = self._manifest, False
                if self._directory.is_dir():  # one that was removed is not made again unasked
                    replace_file(self._directory / MANIFEST_NAME, manifest.encode())
            except OSError:
                return
            finally:
                self._writing.release()


def complete_manifest(directory: Path) -> str:
    """List the finished segments that a killed recorder, or a repair, has left unlisted; where there is no manifest
    that counts, make one of what is there. Why that was made; "" when there was one. SessionError when no segment says
    which session it is, OSError when the disk refuses."""
    for left in directory.glob(f".{MANIFEST_NAME}.*.part"):
        left.unlink(missing_ok=True)
    before = read_manifest(directory)
    if isinstance(before, NoManifest):
        if not before.is_newer:
            write_manifest(directory, remade=True)
        return "" if before.is_newer else before.text
    if (made := _add_segments(directory, before)) != before:
        replace_file(directory / MANIFEST_NAME, made.encode())
    return ""


def write_manifest(directory: Path, *, remade: bool = False) -> None:
    """One of the finished segments that are there, and of nothing else; SessionError when none can be read, OSError
    when the disk refuses."""
    files = _list_finished(directory)
    if not files:
        raise SessionError(f"{directory}: has no finished segment")
    heads: list[Head] = []
    for file in files:
        with suppress(SessionError):
            heads.append(read_head(file.path))
    if not heads:
        raise SessionError(f"{directory}: no finished segment can be read")
    ((session, _),) = Counter(tuple(sorted(head.session.items())) for head in heads).most_common(1)
    head = next(head for head in heads if head.session == dict(session))
    texts = {name: hash_text(text) for name, text in head.attachments.items()}
    made = _add_segments(directory, Manifest(head.session, texts=texts, ended=True, remade=remade))
    replace_file(directory / MANIFEST_NAME, made.encode())


def _list_finished(directory: Path) -> list[SegmentFile]:
    return [file for file in list_segments(directory) if file.state is SegmentState.FINISHED]


def _add_segments(directory: Path, manifest: Manifest) -> Manifest:
    """Return the manifest with the finished segments of the session that are not listed yet: those of the last moments
    before a kill, and those that a repair has made. One that cannot be read, or is another session's, is left out."""
    for file in _list_finished(directory):
        with suppress(SessionError):
            head = read_head(file.path)
            is_new = file.name not in manifest.segments or (head.salvaged and _is_other_session(file, manifest))
            if is_new and dict(head.session) == dict(manifest.session):
                manifest = manifest.add_segment(file.name, seal_segment(file.path))
    return manifest


def _is_other_session(file: SegmentFile, manifest: Manifest) -> bool:
    known = manifest.segments[file.name]
    return file.size_bytes != known.size_bytes or seal_segment(file.path) != known


def seal_segment(path: Path) -> Sealed:
    """A finished segment as it is; SessionError when it cannot be read."""
    with convert_damage(path), path.open("rb") as file:
        found = read_contents(path)
        return Sealed(found.size_bytes, hashlib.file_digest(file, "sha256").hexdigest(), found.counts, found.digest)
