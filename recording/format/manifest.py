"""`session.json`: what a session is to have, stated by its recorder next to the segments.

It is written when a recording begins, each time a segment is finished, when the plan is known, and once more when the
recording ends, always as a whole. A recorder that is killed between a segment's last name and this file leaves a
segment that is not listed yet; a repair, or the recorder that goes on, lists it. Its own `sha256` is that of all it
says, so that an edited one is found.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Self, cast

from thermostand.foundation.json_values import parse_json_object
from thermostand.recording.format.layout import FORMAT, explain_unknown_format

MANIFEST_NAME = "session.json"
_LIMIT_BYTES = 64_000_000  # hundreds of thousands of segments


_NOT_EMPTY = ("uid", "extent", "holes")  # left out of the record when they are


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """Who recorded what with which; the metadata record `session` of every segment.

    simulated: the devices were fakes, in real or virtual time. On a virtual clock `host` is not recorded: that run on
    another machine is the same session.

    format: of the files. extent: of a part that was cut out of a session, the range and how the run
    ended, as JSON; holes: of a copy of a session that is not whole, what the original lacked (holes.py). uid:
    of this session alone, in hex digits, also when another one of its second and recipe has the same `session_id`; on a
    virtual clock it follows from the seed.
    """

    session_id: str
    recipe: str
    camera_serial: str
    operator: str
    software_version: str
    clock_source: Literal["wall", "virtual"]
    simulated: bool = False
    host: str = ""
    format: str = str(FORMAT)
    extent: str = ""
    holes: str = ""
    uid: str = ""

    def metadata(self) -> dict[str, str]:
        """The fields as MCAP metadata."""
        texts: dict[str, str] = {**asdict(self), "simulated": str(self.simulated).lower()}
        if self.clock_source == "virtual":
            del texts["host"]
        return {name: text for name, text in texts.items() if text or name not in _NOT_EMPTY}

    @classmethod
    def of(cls, metadata: Mapping[str, str]) -> Self:
        """The inverse: segments that are added to a session have its own record; a field it lacks is ""."""
        known: dict[str, Any] = {field.name: metadata.get(field.name, "") for field in fields(cls)}
        return cls(**{**known, "simulated": known["simulated"] == "true"})


@dataclass(frozen=True, slots=True)
class Sealed:
    """A finished segment: its size, the SHA-256 of all its bytes, how many messages it has of each topic, and their
    digest (mcap_contents.py), which stays when another program writes the file in another form; "" is not stated."""

    size_bytes: int
    sha256: str
    messages: Mapping[str, int]
    content: str = ""


@dataclass(frozen=True, slots=True)
class JournalDigest:
    """The first lines of a journal: how many, their bytes, and the SHA-256 of these."""

    lines: int
    size_bytes: int
    sha256: str


def digest_journal(data: bytes) -> JournalDigest:
    """Compute the digest of all whole lines in `data`."""
    whole = data[: data.rfind(b"\n") + 1]
    return JournalDigest(whole.count(b"\n"), len(whole), hashlib.sha256(whole).hexdigest())


@dataclass(frozen=True, slots=True)
class Manifest:
    """session: the record of that name of every segment. devices: name -> kind and channels, each with its unit, as
    they were declared. texts: name -> hash of what is attached. plan: how many `steps` and `frames` it has, {} before
    it is known. segments: the finished ones by their names within the session. journal: as it was when the recording
    ended. ended: the recorder has finished everything. remade: a repair has made this file of what was there, so that
    what was missing before is not known."""

    session: Mapping[str, str]
    devices: Mapping[str, Mapping[str, object]] = field(default_factory=dict[str, Mapping[str, object]])
    texts: Mapping[str, str] = field(default_factory=dict[str, str])
    plan: Mapping[str, int] = field(default_factory=dict[str, int])
    segments: Mapping[str, Sealed] = field(default_factory=dict[str, Sealed])
    journal: JournalDigest | None = None
    ended: bool = False
    remade: bool = False

    @property
    def sha256(self) -> str:
        """The hash of all it lists, and so of the whole session."""
        return _compute_sha256({"format": FORMAT, **asdict(self)})

    def encode(self) -> bytes:
        """The file; the same of the same contents."""
        fields = {"format": FORMAT, **asdict(self), "sha256": self.sha256}
        return json.dumps(fields, indent=1, sort_keys=True).encode() + b"\n"

    def add_segment(self, name: str, sealed: Sealed) -> Manifest:
        """Return the manifest with that segment more, or with it as it is now."""
        return replace(self, segments={**self.segments, name: sealed})


@dataclass(frozen=True, slots=True)
class NoManifest:
    """Why there is none that counts, as the part of a sentence. is_missing: no such file; is_newer: of a format that
    this version does not know."""

    text: str
    is_missing: bool = False
    is_newer: bool = False


def _compute_sha256(fields: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def read_manifest(directory: Path) -> Manifest | NoManifest:
    """The manifest of the session in `directory`, or why there is none."""
    path = directory / MANIFEST_NAME
    try:
        if not path.exists():
            return NoManifest("is missing", is_missing=True)
        if not path.is_file() or path.stat().st_size > _LIMIT_BYTES:
            return NoManifest("is no file, or far too large")
        return _decode(path.read_bytes())
    except OSError as error:
        return NoManifest(f"cannot be read ({error.strerror})")


def _decode(data: bytes) -> Manifest | NoManifest:
    fields = parse_json_object(data)
    if fields is None:
        return NoManifest("is damaged: it is no JSON object")
    number = fields.get("format")
    if fault := explain_unknown_format({"format": str(number)}):
        return NoManifest(fault, is_newer=isinstance(number, int))
    stated = fields.pop("sha256", None)
    try:
        is_as_written = stated == _compute_sha256(fields)
    except RecursionError:  # nested too deep to be written
        is_as_written = False
    if not is_as_written:
        return NoManifest("was edited or is damaged: it does not fit its own checksum")
    try:
        return _build_manifest(cast("dict[str, Any]", fields))
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        return NoManifest(f"does not say what every one says ({type(error).__name__}: {error})")


def _build_manifest(stated: Mapping[str, Any]) -> Manifest:
    """The fields as their types; LookupError, TypeError, ValueError or AttributeError when they are others."""
    segments = {str(name): Sealed(**each) for name, each in stated["segments"].items()}
    journal = None if stated["journal"] is None else JournalDigest(**stated["journal"])
    devices = {str(name): dict(each) for name, each in stated["devices"].items()}
    texts = [
        *stated["session"].values(),
        *stated["texts"].values(),
        *(text for each in segments.values() for text in (each.sha256, each.content)),
    ]
    counts = [*stated["plan"].values(), *(count for each in segments.values() for count in each.messages.values())]
    counts += [each.size_bytes for each in segments.values()] + ([journal.lines, journal.size_bytes] if journal else [])
    if not all(isinstance(text, str) for text in texts) or not all(isinstance(count, int) for count in counts):
        raise TypeError("a text or a number is something else")
    flags = bool(stated["ended"]), bool(stated["remade"])
    return Manifest(stated["session"], devices, stated["texts"], stated["plan"], segments, journal, *flags)
