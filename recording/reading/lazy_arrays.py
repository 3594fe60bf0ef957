"""A session as labelled arrays for xarray: frames that are read when they are computed, and readings with units.

    arrays = session.to_xarray()
    arrays["camera"].image[:, 900:1100, 1100:1300].mean(("row", "column")).compute()
    arrays.telemetry["thermometers.air"]

Opening reads the tables of frames only. An image is one chunk of a dask array, and what is cut out of it is all that
stays in memory, once: such a part of several frames is not to be written to, its `.copy()` is. Readings are decoded
when the first of them is asked for. It takes the extra `arrays`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from threading import Lock
from typing import Any, Protocol, cast
from weakref import WeakValueDictionary

import numpy as np
from dask.array.core import from_array
from dask.array.dispatch import concatenate_lookup
from dask.base import tokenize
from numpy.typing import NDArray
from xarray import Dataset
from xarray.backends import BackendArray
from xarray.core import indexing

from thermostand.foundation.errors import SessionError
from thermostand.recording.format.decoded_items import decode_frame, read_recorded_image
from thermostand.recording.format.images import ImageArray
from thermostand.recording.format.records import FramePlace
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.columns import ChannelColumn
from thermostand.recording.reading.frames_table import FramesTable
from thermostand.recording.reading.interpolation import interpolate
from thermostand.recording.reading.recorded_devices import recorded_devices


class RecordedFrames(Protocol):
    """What is asked of a session, see there."""

    path: Path
    metadata: dict[str, str]

    @property
    def telemetry_segments(self) -> tuple[Path, ...]: ...  # noqa: D102
    def units(self) -> Mapping[str, str]: ...  # noqa: D102
    def readings(self, channel: str) -> ChannelColumn: ...  # noqa: D102
    def frames_table(self) -> FramesTable: ...  # noqa: D102


class SessionArrays(Mapping[str, Dataset]):
    """A Dataset of frames for each camera, by its name, and one of the readings: `telemetry`.

    A camera's Dataset has `image` (time, row, column), uint8 or uint16, in DN: a dask array, one chunk a frame. Further
    variables are all channels of the telemetry (`thermometers.air`, with `units`), linear between readings and NaN
    across gaps of more than 120 s, at the middle of each exposure. Coordinates: `time`, datetime64[ns] of the stand's
    clock, which never steps, and the columns of FramesTable (role, step_id, chamber_degC: the set-point, camera_degC,
    air_degC, flags, superseded, `linear_position` and the like); `time_utc` as the computer's clock had it.

    KeyError when there is no such camera. SessionError when a camera's frames are not of one size and, in computing,
    when the session is damaged there.
    """

    def __init__(self, session: RecordedFrames, places: Sequence[FramePlace], utc: Callable[[], UtcOffsets]) -> None:
        self._session, self._utc_offsets, self._lock = session, utc, Lock()
        self._places: dict[str, list[FramePlace]] = {}
        for place in places:
            self._places.setdefault(place.meta.channel.removesuffix(".image"), []).append(place)

    def __getitem__(self, camera: str) -> Dataset:
        """The frames of that camera in order of time."""
        if camera not in self._places:
            raise KeyError(f"no frames of {camera!r}; there are {', '.join(self._places) or 'none at all'}")
        places = self._places[camera]
        metas = [place.meta for place in places]
        sizes = {(meta.width, meta.height, meta.significant_bits) for meta in metas}
        if len(sizes) > 1:
            text = ", ".join(f"{width} x {height} px of {bits} bits" for width, height, bits in sorted(sizes))
            raise SessionError(f"{self._session.path}: the frames of {camera} are no one array, they are of {text}")
        times_ns = np.array([meta.time_ns for meta in metas], np.int64)
        images, count = _Images(places), len(places)
        token = tokenize(str(self._session.path), camera, count, times_ns[0], times_ns[-1])
        image: Any = from_array(
            images, chunks=cast(Any, (1, *images.shape[1:])), name=f"image-{token}", asarray=True, lock=False
        )
        coordinates: dict[str, object] = {
            "time": times_ns.astype("datetime64[ns]"),
            "step_id": ("time", np.array([meta.step_id for meta in metas], np.str_)),
            "role": ("time", np.array([meta.role for meta in metas], np.str_)),
            "flags": ("time", np.array([",".join(meta.flags) for meta in metas], np.str_)),
            "chamber_degC": ("time", np.array([meta.chamber_degC for meta in metas]), {"units": "degC"}),
            "camera_degC": ("time", np.array([meta.camera_degC for meta in metas]), {"units": "degC"}),
        }
        units = self._declared_units
        later = {"superseded": ("bool", ""), "air_degC": ("float64", "degC")}
        for channel in units:
            device, _, name = channel.partition(".")
            if name == "moving":
                later[f"{device}_position"] = ("float64", units.get(f"{device}.position", ""))
        for name, (kind, unit) in later.items():
            coordinates[name] = (
                "time",
                self._later(partial(self._of_table, name, times_ns), kind, count),
                {"units": unit},
            )
        coordinates["time_utc"] = ("time", self._later(partial(self._utc, times_ns), "datetime64[ns]", count))
        variables = {
            channel: (
                "time",
                self._later(partial(self._interpolated, channel, times_ns), "float64", count),
                {"units": unit},
            )
            for channel, unit in units.items()
        }
        attributes = {"camera": camera, **self._session.metadata}
        images_variable = (("time", "row", "column"), image, {"units": "DN"})
        return Dataset({"image": images_variable, **variables}, coordinates, attributes)

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def __repr__(self) -> str:
        """The cameras, with how many frames each has."""
        cameras = [f"  {name}: {len(places)} frames" for name, places in self._places.items()]
        return "\n".join([f"SessionArrays of {self._session.path}", *cameras, "  .telemetry"])

    @cached_property
    def telemetry(self) -> Dataset:
        """Each channel as a variable with `units` on the instants of its device, `thermometers_time` and the like:
        datetime64[ns] of the stand's clock. NaN where it was BAD or not read. It decodes all telemetry."""
        with self._lock:
            columns = {name: self._session.readings(name) for name in self._session.units()}
            units = dict(self._session.units())
        by_device: dict[str, list[str]] = {}
        for name in columns:
            by_device.setdefault(name.partition(".")[0], []).append(name)
        coordinates: dict[str, object] = {}
        variables: dict[str, object] = {}
        for device, names in by_device.items():
            instants = np.unique(np.concatenate([columns[name][0] for name in names]))
            coordinates[f"{device}_time"] = instants.astype("datetime64[ns]")
            for name in names:
                values = np.full(len(instants), np.nan)
                values[np.searchsorted(instants, columns[name][0])] = columns[name][1]
                variables[name] = (f"{device}_time", values, {"units": units[name]})
        return Dataset(variables, coordinates, dict(self._session.metadata))

    @cached_property
    def _declared_units(self) -> dict[str, str]:
        """Unit by channel, as the devices declare them."""
        devices = recorded_devices(self._session.telemetry_segments).items()
        return {f"{name}.{each.name}": each.unit for name, device in devices for each in device.channels}

    def _later(self, compute: Callable[[], NDArray[Any]], kind: str, count: int) -> object:
        """(count,), computed when it is looked at; a Session is read by one thread at a time."""

        def locked() -> NDArray[Any]:
            with self._lock:
                return compute()

        return indexing.LazilyIndexedArray(_Later(locked, kind, count))

    @cached_property
    def _table(self) -> dict[str, NDArray[np.generic]]:
        return self._session.frames_table().columns()

    def _of_table(self, name: str, times_ns: NDArray[np.int64]) -> NDArray[Any]:
        """A column of FramesTable at the frames of one camera."""
        if name not in self._table:  # of an axis that was declared, and never read
            return np.full(len(times_ns), np.nan)
        return self._table[name][np.searchsorted(self._table["time_ns"], times_ns)]

    def _utc(self, times_ns: NDArray[np.int64]) -> NDArray[Any]:
        utc = self._utc_offsets()
        return np.array([utc.utc_ns(each) for each in times_ns.tolist()], np.int64).astype("datetime64[ns]")

    def _interpolated(self, channel: str, times_ns: NDArray[np.int64]) -> NDArray[Any]:
        if channel not in self._session.units():  # declared, and never read
            return np.full(len(times_ns), np.nan)
        return interpolate(*self._session.readings(channel), times_ns)


class _Later(BackendArray):
    """One column that is computed once, when some of it is asked for."""

    def __init__(self, compute: Callable[[], NDArray[Any]], kind: str, count: int) -> None:
        self._compute = cache(compute)
        self.shape, self.dtype = (count,), np.dtype(kind)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        whole = indexing.IndexingSupport.OUTER
        return indexing.explicit_indexing_adapter(key, self.shape, whole, self._cut)

    def _cut(self, at: tuple[Any, ...]) -> NDArray[Any]:
        return self._compute()[at]


class _Images:
    """Frames as an array (time, row, column) that is read where it is indexed."""

    def __init__(self, places: list[FramePlace]) -> None:
        self._places = places
        meta = places[0].meta
        self.shape = (len(places), meta.height, meta.width)
        self.dtype = np.dtype(np.uint8 if meta.significant_bits <= 8 else np.uint16)
        self.ndim = 3
        self._results: WeakValueDictionary[str, _Result] = WeakValueDictionary()
        self._lock = Lock()

    def __getitem__(self, cut: tuple[int | slice, int | slice, int | slice]) -> NDArray[np.generic]:
        """A copy, so that the rest of each image can go."""
        places, within = self._places[cut[0]], cut[1:]
        if isinstance(places, FramePlace):
            return np.array(_image(places)[within])
        if not places:
            return np.broadcast_to(np.zeros((), self.dtype), self.shape)[cut]
        if len(places) == 1 and isinstance(cut[0], slice):
            return self._put(range(len(self._places))[cut[0]].start, within, _image(places[0])[within])
        return np.stack([_image(place)[within] for place in places])

    def _put(self, index: int, within: object, image: NDArray[np.generic]) -> NDArray[np.generic]:
        """A copy of what was cut out of one frame, (1, rows, columns), where the copies of the others are, too."""
        if image.nbytes * len(self._places) > _RESULT_LIMIT_BYTES:
            return np.array(image)[np.newaxis]
        with self._lock:
            found = self._results.get(repr(within))
            if found is None or found.is_taken[index]:  # by somebody who may still have it
                shape = (len(self._places), *image.shape)
                found = self._results[repr(within)] = _Result(np.empty(shape, image.dtype), np.zeros(shape[0], bool))
            found.is_taken[index] = True
        found.values[index] = image
        piece = found.values[index : index + 1].view(_Piece)
        piece.result, piece.index = found, index
        return piece


# dask keeps the pieces of a result until it has copied all of them: a region of 3,600 frames is in memory twice. So the
# pieces are made where the result is to be, and are not copied again when all of it is asked for.

_RESULT_LIMIT_BYTES = 1 << 28  # beyond it a result may not be wanted whole, as when each image is averaged


@dataclass(eq=False)
class _Result:
    """Room for the same part of all frames, of which no page is in memory before it is written; which are taken."""

    values: NDArray[Any]
    is_taken: NDArray[np.bool_]


class _Piece(np.ndarray[Any, Any]):
    """A part of one frame in its place in a result; what numpy makes of it is in none."""

    __array_priority__ = 1.0  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType] as numpy has it
    result: _Result | None = None
    index = 0

    def __array_finalize__(self, made_of: object) -> None:
        self.result = None


def _join(pieces: Sequence[NDArray[Any]], axis: int = 0) -> NDArray[Any]:
    """The pieces as one array: not to be written to where it is no copy."""
    if len(pieces) == 1:
        return pieces[0]
    first = pieces[0]
    result = first.result if isinstance(first, _Piece) and axis == 0 else None
    if result is not None and isinstance(first, _Piece):
        in_order = (
            isinstance(each, _Piece) and each.result is result and each.index == first.index + place
            for place, each in enumerate(pieces)
        )
        if all(in_order):
            joined = result.values[first.index : first.index + len(pieces)]
            joined.flags.writeable = False  # somebody may have kept the pieces
            return joined
    return np.concatenate([np.asarray(each) for each in pieces], axis)


concatenate_lookup.register(_Piece, _join)


def _image(place: FramePlace) -> ImageArray:
    return decode_frame(read_recorded_image(place)).image
