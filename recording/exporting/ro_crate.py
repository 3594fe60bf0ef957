"""RO-Crate 1.1 next to an export: what the data are, who recorded them with what, as JSON-LD that repositories read.

https://www.researchobject.org/ro-crate/specification/1.1/: a metadata descriptor, the root data set with name,
description, date, licence and its parts, and here the action that made it. A folder of thousands of frames is one part.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

from thermostand.foundation.files import write_atomically
from thermostand.recording.exporting.state import describe_state
from thermostand.recording.reading.session import Session

CRATE_NAME = "ro-crate-metadata.json"
_CONTEXT = "https://w3id.org/ro/crate/1.1/context"
_PROFILE = "https://w3id.org/ro/crate/1.1"
_FORMATS = {
    ".csv": "text/csv",
    ".json": "application/json",
    ".mcap": "application/octet-stream",
    ".nxs": "application/x-hdf5",
    ".h5": "application/x-hdf5",
    ".parquet": "application/vnd.apache.parquet",
    ".txt": "text/plain",
}
_NO_LICENSE = "No licence is stated by those who recorded these data; ask them before you use them."


def write_crate(session: Session, out: Path, folder: Path | None = None) -> None:
    """Write the crate of an export: into `folder`, which becomes the folder `out`, or for one file `out` next to it, as
    `NAME-ro-crate-metadata.json`. SessionError when the disk refuses."""
    parts = [out] if folder is None else sorted(path for path in folder.iterdir() if path.name != CRATE_NAME)
    place = out.with_name(f"{out.name}-{CRATE_NAME}") if folder is None else folder / CRATE_NAME
    graph = {"@context": _CONTEXT, "@graph": list(_iterate_entities(session, parts))}
    write_atomically(place, json.dumps(graph, indent=1, ensure_ascii=False) + "\n")


def _iterate_entities(session: Session, parts: Sequence[Path]) -> Iterator[dict[str, object]]:
    known, utc, state = session.metadata, session.utc, describe_state(session)
    name = known.get("session_id", session.path.name)
    begin, end = (utc.utc_text(each or 0) for each in (session.scanned.begin_ns, session.scanned.end_ns))
    described = [_describe_part(path) for path in parts]
    yield {
        "@id": CRATE_NAME,
        "@type": "CreativeWork",
        "conformsTo": {"@id": _PROFILE},
        "about": {"@id": "./"},
    }
    yield {
        "@id": "./",
        "@type": "Dataset",
        "name": f"Thermal test of a camera: {name}",
        "description": f"Frames and readings of the session {name} (recipe {known.get('recipe', '')}), run "
        f"{session.run}, files {state.files}; {session.frame_count} frames."
        + (" Simulated devices." if known.get("simulated") == "true" else ""),
        "identifier": known.get("uid") or name,
        "datePublished": end[:10],
        "temporalCoverage": f"{begin}/{end}",
        "license": {"@id": "#license"},
        "hasPart": [{"@id": each["@id"]} for each in described],
        "mentions": {"@id": "#recording"},
    }
    yield {"@id": "#license", "@type": "CreativeWork", "name": "No licence", "description": _NO_LICENSE}
    yield {
        "@id": "#recording",
        "@type": "CreateAction",
        "name": f"recording of {name}",
        "startTime": begin,
        "endTime": end,
        "agent": {"@id": "#operator"},
        "instrument": [{"@id": "#software"}, {"@id": "#camera"}],
        "result": {"@id": "./"},
    }
    yield {"@id": "#operator", "@type": "Person", "name": known.get("operator") or "not stated"}
    yield {
        "@id": "#software",
        "@type": "SoftwareApplication",
        "name": "thermostand",
        "version": known.get("software_version", ""),
    }
    camera = {"name": "camera", "serialNumber": known.get("camera_serial", "")}
    yield {"@id": "#camera", "@type": "IndividualProduct", **camera}
    yield from described


def _describe_part(path: Path) -> dict[str, object]:
    if path.is_dir():
        count = sum(each.is_file() for each in path.rglob("*"))
        return {"@id": f"{quote(path.name)}/", "@type": "Dataset", "name": path.name, "description": f"{count} files"}
    return {
        "@id": quote(path.name),
        "@type": "File",
        "name": path.name,
        "contentSize": str(path.stat().st_size),
        "encodingFormat": _FORMATS.get(path.suffix, "application/octet-stream"),
    }
