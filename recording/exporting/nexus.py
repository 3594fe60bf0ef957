"""A session as one NeXus file (HDF5): frames as detectors, readings as logs, and what was attached as notes.

    /entry                     NXentry: title, identifier, start and end
      instrument/CAMERA        NXdetector: data (time, row, column), and of each frame its instant, exposure, gain,
                               temperature, step, role and set-point
      CAMERA                   NXdata: the same images, for viewers
      telemetry/DEVICE.CHANNEL NXlog: time, value
      sample                   NXsample: the target
      user                     NXuser: who operated the stand
      notes/..., attachments/...  NXnote: what people wrote; configuration, recipe and target as they were recorded
      steps, events            NXcollection: columns

Instants are seconds since `start` in UTC, as NeXus has them, and `time_ns` of the stand's clock, which never steps. An
image is one chunk, compressed by gzip, which every HDF5 library has; one image is in memory at a time. It takes the
extra `nexus` (h5py).
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.extras import import_extra
from thermostand.foundation.files import make_durable_folder, name_part, sync_folder
from thermostand.recording.exporting.state import describe_state
from thermostand.recording.format.decoded_items import decode_frame
from thermostand.recording.format.messages import FrameMeta
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.notes import read_notes
from thermostand.recording.reading.session import Session

_LEVEL = 1  # of gzip: 9 takes ten times as long for a few percent of a camera's noise


def export_nexus(
    session: Session,
    out: Path,
    *,
    frames: bool = True,
    telemetry: bool = True,
    report: Callable[[float, str], None],
) -> None:
    """Write `session` as the file `out`, which must not exist, laid out as above; memory stays flat.

    `report` gets the share of the frames that is done (0 to 1). SessionError when the session cannot be read, the
    frames of a camera are not of one size, `out` cannot be written, or h5py is not installed; `out` then does not
    appear.
    """
    h5py = import_extra("h5py", "nexus")
    part = name_part(out)
    try:
        make_durable_folder(out.parent)
        with h5py.File(part, "x") as file:
            _Writer(session, file, report).write(frames, telemetry)
        with part.open("rb") as written:
            os.fsync(written.fileno())
        part.rename(out)
        sync_folder(out.parent)
    except OSError as error:
        raise SessionError(f"{out}: cannot be written ({error})") from error
    finally:
        part.unlink(missing_ok=True)


class _Writer:
    """One file."""

    def __init__(self, session: Session, file: Any, report: Callable[[float, str], None]) -> None:
        self._session, self._report = session, report
        self._utc: UtcOffsets = session.utc
        self._start_ns = session.scanned.begin_ns or 0
        self._start = self._utc.utc_text(self._start_ns)
        file.attrs.update({"NX_class": "NXroot", "default": "entry", "creator": "thermostand"})
        self._entry = _make_group(file, "entry", "NXentry")

    def write(self, frames: bool, telemetry: bool) -> None:
        self._write_facts()
        cameras = dict.fromkeys(meta.channel for meta in self._session.frame_metas()) if frames else {}
        instrument = _make_group(self._entry, "instrument", "NXinstrument")
        instrument["name"] = "thermal test stand"
        sets = {channel: self._make_detector(instrument, channel) for channel in cameras}
        done: dict[str, int] = dict.fromkeys(cameras, 0)
        total = self._session.frame_count
        for number, image in enumerate(self._session.images() if frames else (), 1):
            channel = image.meta.channel
            sets[channel][done[channel]] = decode_frame(image).image
            done[channel] += 1
            self._report(number / total, f"frame {number} of {total}")
        if telemetry:
            logs = _make_group(self._entry, "telemetry", "NXcollection")
            for channel, unit in self._session.units().items():
                self._write_log(logs, channel, unit)

    def _write_facts(self) -> None:
        session, entry = self._session, self._entry
        known, state = session.metadata, describe_state(session)
        entry["title"] = known.get("recipe", "")
        entry["entry_identifier"] = known.get("session_id", "")
        entry["start_time"] = self._start
        entry["end_time"] = self._utc.utc_text(session.scanned.end_ns or self._start_ns)
        entry["program_name"] = "thermostand"
        entry["program_name"].attrs["version"] = known.get("software_version", "")
        _make_group(entry, "user", "NXuser")["name"] = known.get("operator", "")
        sample = _make_group(entry, "sample", "NXsample")
        sample["name"] = "target"
        sample["description"] = session.attachment("target.yaml") or ""
        notes = _make_group(entry, "notes", "NXcollection")
        _make_note(notes, "state", state.text, "text/plain", "the state of the session's files when it was exported")
        _make_note(
            notes,
            "session",
            json.dumps(dict(known), ensure_ascii=False),
            "application/json",
            "the record of the session",
        )
        for number, note in enumerate(read_notes(session.path).notes, 1):
            group = _make_note(
                notes, f"note_{number}", note.text, "text/plain", "what somebody wrote about the session"
            )
            group["author"], group["date"] = note.by, self._utc.utc_text(note.time_ns)
        attached = _make_group(entry, "attachments", "NXcollection")
        for number, (name, text) in enumerate(session.attachments.items(), 1):
            kind = "application/yaml" if name.endswith(".yaml") else "text/plain"
            _make_note(attached, f"attachment_{number}", text, kind, "as it was recorded")["file_name"] = name
        self._write_columns("steps", session.steps(), ("step_id", "index", "kind", "state"))
        self._write_columns("events", session.events(), ("level", "kind", "text"))

    def _write_columns(self, name: str, items: Sequence[Any], fields: Sequence[str]) -> None:
        """Steps or events, one entry each in every column."""
        group = _make_group(self._entry, name, "NXcollection")
        self._write_times(group, np.array([item.time_ns for item in items], np.int64))
        for field in fields:
            values = [getattr(item, field) for item in items]
            _write_column(group, field, values if field == "index" else [str(value) for value in values])

    def _make_detector(self, instrument: Any, channel: str) -> Any:
        """The detector of a camera, its images still blank; the data set for them."""
        name = channel.removesuffix(".image")
        metas = [meta for meta in self._session.frame_metas() if meta.channel == channel]
        sizes = {(meta.height, meta.width, meta.significant_bits > 8) for meta in metas}
        if len(sizes) > 1:
            text = ", ".join(f"{width} x {height} px" for height, width, _ in sorted(sizes))
            raise SessionError(f"{self._session.path}: the frames of {name} are no one array, they are of {text}")
        ((height, width, is_deep),) = sizes
        group = _make_group(instrument, name, "NXdetector")
        group["local_name"] = name
        if name == self._session.camera:
            group["serial_number"] = self._session.metadata.get("camera_serial", "")
        images = group.create_dataset(
            "data",
            (len(metas), height, width),
            "uint16" if is_deep else "uint8",
            chunks=(1, height, width),
            compression="gzip",
            compression_opts=_LEVEL,
        )
        images.attrs.update({"units": "counts", "long_name": f"images of {name}, DN", "interpretation": "image"})
        times_ns = np.array([meta.time_ns for meta in metas], np.int64)
        self._write_times(group, times_ns)
        _write_frame_columns(group, metas)
        viewed = _make_group(self._entry, name, "NXdata")
        viewed.attrs.update({"signal": "data", "axes": ["time", ".", "."], "time_indices": 0})
        viewed["data"], viewed["time"] = images, group["time"]
        self._entry.attrs.setdefault("default", name)
        return images

    def _write_log(self, logs: Any, channel: str, unit: str) -> None:
        group = _make_group(logs, channel.replace("/", "_per_"), "NXlog")
        times_ns, values = self._session.readings(channel)
        self._write_times(group, times_ns)
        _write_column(group, "value", values, unit)
        group["description"] = f"{channel}; nan where it was not measured"

    def _write_times(self, group: Any, times_ns: NDArray[np.int64]) -> None:
        """The instants, shape (n,), in both forms."""
        utc_ns = np.array([self._utc.utc_ns(each) for each in times_ns.tolist()], np.int64)
        _write_column(group, "time", (utc_ns - self._utc.utc_ns(self._start_ns)) / NS_PER_S, "s")
        group["time"].attrs["start"] = self._start
        _write_column(group, "time_ns", times_ns, "ns")
        group["time_ns"].attrs["long_name"] = "the stand's clock, which never steps, since 1970"


def _write_frame_columns(group: Any, metas: Sequence[FrameMeta]) -> None:
    for name, field, unit in (
        ("count_time", "exposure_s", "s"),
        ("gain", "gain_dB", "dB"),
        ("temperature", "camera_degC", "degC"),
        ("set_point", "chamber_degC", "degC"),
        ("block_id", "block_id", ""),
        ("dropped", "dropped", ""),
        ("step_id", "step_id", ""),
        ("role", "role", ""),
    ):
        _write_column(group, name, [getattr(meta, field) for meta in metas], unit)
    _write_column(group, "flags", [",".join(meta.flags) for meta in metas])


def _write_column(group: Any, name: str, values: Sequence[Any] | NDArray[Any], unit: str = "") -> None:
    """One column of n entries; texts are variable-length UTF-8."""
    found = np.asarray(values, object if len(values) and isinstance(values[0], str) else None)
    if found.dtype == object:
        h5py = import_extra("h5py", "nexus")
        group.create_dataset(name, data=found, dtype=h5py.string_dtype())
    else:
        group[name] = found
    if unit:
        group[name].attrs["units"] = unit


def _make_group(parent: Any, name: str, kind: str) -> Any:
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    return group


def _make_note(parent: Any, name: str, text: str, media_type: str, description: str) -> Any:
    note = _make_group(parent, name, "NXnote")
    note["type"], note["description"], note["data"] = media_type, description, text.replace("\0", "")
    return note
