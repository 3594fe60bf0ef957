"""What belongs to an exported frame, as a text file next to it and as a row of the index: the same facts in both."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.instants import format_utc
from thermostand.recording.exporting.tables import Cell, Column
from thermostand.recording.format import messages
from thermostand.recording.format.images import decode_windows
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.recorded_devices import recorded_devices
from thermostand.recording.reading.session import Session

SIDECAR_COLUMNS = (
    Column("file", "text"),
    Column("time_utc", "utc"),
    Column("time_ns", "ns"),
    Column("camera_temperature_degC", "value"),
    Column("exposure_s", "value"),
    Column("gain_dB", "value"),
    Column("channel", "word"),
    Column("block_id", "count"),
    Column("camera_ticks_ns", "count"),
    Column("dropped", "count"),
    Column("step_id", "word"),
    Column("flags", "word"),
    Column("significant_bits", "count"),
    Column("windows_px", "text"),
)


def list_frame_facts(file: str, meta: messages.FrameMeta, utc: UtcOffsets) -> tuple[Cell, ...]:
    """The cells of SIDECAR_COLUMNS. windows_px: `x,y,width,height;...` of a frame of which only these are real."""
    windows = decode_windows(meta)
    return (
        file,
        utc.utc_ns(meta.time_ns),
        meta.time_ns,
        meta.camera_degC,
        meta.exposure_s,
        meta.gain_dB,
        meta.channel,
        meta.block_id,
        meta.camera_ticks,
        meta.dropped,
        meta.step_id,
        ",".join(meta.flags),
        meta.significant_bits,
        "" if windows is None else ";".join(",".join(map(str, window)) for window in windows.tolist()),
    )


def format_sidecar(stand_columns: Sequence[Column], facts: Sequence[Cell]) -> str:
    """A line `name: value` for each fact, the unit in the name; an unknown number is nan, an unknown text empty."""
    lines: list[str] = []
    for column, cell in zip((*SIDECAR_COLUMNS, *stand_columns), facts, strict=True):
        text = format_utc(int(cell or 0)) if column.type == "utc" else "" if cell is None else str(cell)
        lines.append(f"{column.name}: {text}".rstrip())
    return "\n".join(lines) + "\n"


class StandTemperatures:
    """The temperatures of the stand as they were last read at an instant, each with its age.

    `columns` are a value and an age for each channel in degC, those that their devices declare before others; NaN is a
    channel whose last reading was BAD, or that had not been read yet, which has no age.
    """

    def __init__(self, session: Session) -> None:
        warm = [channel for channel, unit in session.units().items() if unit == "degC"]
        usual = [
            f"{name}.{channel.name}"
            for name, device in recorded_devices(session.telemetry_segments).items()
            for channel in device.channels
        ]
        names = [*(name for name in usual if name in warm), *(name for name in warm if name not in usual)]
        self._readings = [session.readings(name) for name in names]
        self.columns = tuple(
            column for name in names for column in (Column(f"{name}_degC", "value"), Column(f"{name}_age_s", "value"))
        )

    def read_at(self, time_ns: int) -> tuple[float, ...]:
        """The cells of `columns` at that instant."""
        cells: list[float] = []
        for times_ns, values in self._readings:
            last = int(np.searchsorted(times_ns, time_ns, side="right")) - 1
            if last < 0:
                cells += (math.nan, math.nan)
            else:
                cells += (float(values[last]), (time_ns - int(times_ns[last])) / NS_PER_S)
        return tuple(cells)
