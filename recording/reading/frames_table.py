"""What a session knows of each of its frames, as columns: where it is, when and why it was taken, how warm it was."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.errors import SessionError
from thermostand.foundation.extras import import_extra
from thermostand.foundation.items import Event, StepMark
from thermostand.recording.format.capture_restarts import find_restart_times, is_superseded
from thermostand.recording.format.layout import FRAMES
from thermostand.recording.format.records import FramePlace
from thermostand.recording.reading.columns import ChannelColumn
from thermostand.recording.reading.interpolation import Float, interpolate

if TYPE_CHECKING:
    import pandas as pd

_AIR = "thermometers.air"


@dataclass(frozen=True, slots=True, eq=False)
class FramesTable:
    """F frames in order of time; each column has shape (F,). Numbers are NaN when unknown.

    Attributes
    ----------
    file
        The segment that holds the image, within the session.
    time_ns
        Middle of the exposure, int64.
    camera
        Whose it is, "" when unknown.
    step_id, role
        The step that took it, and what for, as the step says; "" when unknown.
    superseded
        Whether its capture was begun again after it, so that it does not count.
    chamber_degC
        The step's set-point.
    camera_degC
        The camera's own temperature.
    flags
        Why it is to be left out of fits (`Frame.flags`), with a comma between them; "" when for no reason.
    air_degC
        Near the camera, interpolated.
    positions
        Of each axis of the table, by its name, in its unit (mm or deg), interpolated.
    """

    file: NDArray[np.str_]
    time_ns: NDArray[np.int64]
    camera: NDArray[np.str_]
    step_id: NDArray[np.str_]
    role: NDArray[np.str_]
    superseded: NDArray[np.bool_]
    chamber_degC: Float
    camera_degC: Float
    flags: NDArray[np.str_]
    air_degC: Float
    positions: Mapping[str, Float] = field(default_factory=dict[str, Float])

    def __len__(self) -> int:
        return len(self.time_ns)

    def __repr__(self) -> str:
        """Ten lines: the columns with their types, and how many frames of which roles."""
        roles, counts = np.unique(self.role, return_counts=True)
        of_roles = ", ".join(f"{count} {role or 'without a role'}" for role, count in zip(roles, counts, strict=True))
        lines = [f"FramesTable of {len(self)} frames" + (f": {of_roles}" if len(self) else "")]
        columns = list(self.columns().items())
        width = max(len(name) for name, _ in columns)
        for name, column in columns[:8]:
            shown = ", ".join(map(str, column[:3])) + (", ..." if len(column) > 3 else "")
            lines.append(f"  {name:<{width}}  {shown}")
        lines.append("  " + ", ".join(name for name, _ in columns[8:]) + "; to_pandas(), to_arrow()")
        return "\n".join(lines)

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """Name -> column, the axes as `linear_position`: what pandas.DataFrame and the like take."""
        names = (
            "file",
            "time_ns",
            "camera",
            "step_id",
            "role",
            "superseded",
            "chamber_degC",
            "camera_degC",
            "flags",
            "air_degC",
        )
        own: dict[str, NDArray[np.generic]] = {name: getattr(self, name) for name in names}
        return own | {f"{axis}_position": column for axis, column in self.positions.items()}

    def to_pandas(self) -> pd.DataFrame:
        """The columns, a row for each frame. SessionError when pandas is not installed (extra `arrays`)."""
        return import_extra("pandas", "arrays").DataFrame(self.columns())

    def to_arrow(self) -> Any:
        """The columns as a pyarrow.Table, for polars (`polars.from_arrow`), DuckDB and others that read Arrow.
        SessionError when pyarrow is not installed (extra `parquet`)."""
        return import_extra("pyarrow", "parquet").table(self.columns())


class RecordedSession(Protocol):
    """What is asked of a session."""

    def steps(self) -> list[StepMark]:
        """Every step mark."""
        ...

    def events(self) -> list[Event]:
        """Every event."""
        ...

    def channels(self) -> list[str]:
        """The channels that have readings."""
        ...

    def readings(self, channel: str) -> ChannelColumn:
        """(time_ns, value); SessionError when there is no such channel."""
        ...


def build_frames_table(session: RecordedSession, places: Sequence[FramePlace]) -> FramesTable:
    """The table of the frames at these places."""
    metas = [place.meta for place in places]
    times_ns = np.array([meta.time_ns for meta in metas], np.int64)
    step_id = [meta.step_id for meta in metas]
    steps = {mark.step_id: mark.parameters for mark in session.steps() if "role" in mark.parameters}
    begins_ns = find_restart_times(session.events())
    named = zip(times_ns.tolist(), step_id, strict=True)
    return FramesTable(
        file=np.array([f"{FRAMES}/{place.path.name}" for place in places], np.str_),
        time_ns=times_ns,
        camera=np.array([meta.channel.partition(".")[0] for meta in metas], np.str_),
        step_id=np.array(step_id, np.str_),
        role=np.array([str(steps.get(name, {}).get("role") or "") for name in step_id], np.str_),
        superseded=np.array([is_superseded(time_ns, name, begins_ns) for time_ns, name in named], bool),
        chamber_degC=np.array([_to_float(steps.get(name, {}).get("chamber_degC")) for name in step_id], np.float64),
        camera_degC=np.array([meta.camera_degC for meta in metas], np.float64),
        flags=np.array([",".join(meta.flags) for meta in metas], np.str_),
        air_degC=_interpolate_at(session, _AIR, times_ns),
        positions={axis: _interpolate_at(session, f"{axis}.position", times_ns) for axis in _list_axes(session)},
    )


def _to_float(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _list_axes(session: RecordedSession) -> list[str]:
    """The devices that report a position and whether they move."""
    channels = set(session.channels())
    return [name.removesuffix(".moving") for name in sorted(channels) if name.endswith(".moving")]


def _interpolate_at(session: RecordedSession, channel: str, times_ns: NDArray[np.int64]) -> Float:
    try:
        return interpolate(*session.readings(channel), times_ns)
    except SessionError:
        return np.full(len(times_ns), np.nan)
