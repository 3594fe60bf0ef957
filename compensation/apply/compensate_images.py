"""Images, of files or of a session's frames, as they would have been at the reference temperature.

For measurement correct the centres, not the image; a warped image is for software that wants pixels. The result is
float32: rounding it to 8 bits afterwards costs what it costs (about 0.3 DN), and is the user's choice.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.apply.resample import BLOCK_px, Image, resample
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift_runtime import source_offset
from thermostand.compensation.history.states import Float, States
from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import write_whole_bytes

Form = Literal["tiff", "png"]
Shift = Callable[[Float], Float]
"""Points (N, 2) px of the measured image -> their displacement (N, 2), px, to the reference."""


def corrected_image(image: Image, model: DriftModel, states: States) -> NDArray[np.float32]:
    """The grey image (height, width) at the reference, float32, for one thermal state; SessionError when it is not of
    the model's size, or when the state does not determine the drift."""
    height, width = image.shape
    own_width, own_height = model.facts.image_size
    if (width, height) != (own_width, own_height):
        raise SessionError(f"the image has {width} x {height} pixels, the model is of {own_width} x {own_height}")

    def shift(xy_px: Float) -> Float:
        return model.shift(xy_px, states)

    try:
        return warp(image, shift)
    except ValueError as error:
        raise SessionError(
            f"the camera's thermal state is not known well enough for a model of the form {model.form}: {error}"
        ) from error


def middle_flags(model: DriftModel, states: States) -> int:
    """Why the correction at the middle of the image is an extrapolation (Outside), 0 when it is not."""
    width, height = model.facts.image_size
    return int(model.flags(np.array([[(width - 1) / 2, (height - 1) / 2]]), states)[0])


def write_image(path: Path, image: NDArray[np.float32], form: Form, dtype: np.dtype[np.generic]) -> None:
    """tiff: float32 as it is. png: rounded to `dtype`, the original's. The file appears when it is complete;
    SessionError when the place refuses."""
    pixels: NDArray[np.generic] = image
    if form == "png":
        pixels = np.clip(np.round(image), 0, np.iinfo(dtype.name).max).astype(dtype)
    done, data = cv2.imencode(f".{form}", pixels)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if not done:
        raise SessionError(f"{path}: the image cannot be written as {form}")
    write_whole_bytes(path, data.tobytes())


def warp(image: Image, shift: Shift) -> NDArray[np.float32]:
    """The grey image (height, width) with each of its points moved by `shift`, float32 (height, width).

    What was outside the image is its mirror image. The shift is evaluated every 16 px and bilinear in between (0.1 mpx
    for a drift that bends by 0.5 px over the image). NaN in the shift, and one that changes by more than a pixel within
    16, is refused: ValueError.
    """
    height, width = image.shape
    grid_x, grid_y = (np.arange(0, size + BLOCK_px, BLOCK_px, dtype=np.float64) for size in (width, height))
    lattice = np.stack(np.meshgrid(grid_x, grid_y), axis=-1)
    offset = source_offset(shift, lattice.reshape(-1, 2)).reshape(lattice.shape).astype(np.float32)
    if not np.isfinite(offset).all():
        raise ValueError("the shift is not finite everywhere in the image")
    from_x, from_y = np.ascontiguousarray(offset[:, :, 0]), np.ascontiguousarray(offset[:, :, 1])
    return resample(image, from_x, from_y)
