"""An image file as a grey array; its size is looked at before its pixels are."""

from __future__ import annotations

import io
import struct
import warnings
from pathlib import Path

import cv2
import numpy as np
import PIL.Image

from thermostand.foundation.image_limit import describe_size_fault
from thermostand.markers.detection import DetectionError, Image, convert_to_grey

_ORIENTATION, _UPRIGHT = 0x0112, 1
"""EXIF tag (CIPA DC-008, table 4) and its value for pixels that are stored as they are to be shown."""
_TURNS = {
    2: "mirrored",
    3: "turned by 180 deg",
    4: "mirrored",
    5: "mirrored and turned",
    6: "turned by 90 deg",
    7: "mirrored and turned",
    8: "turned by 270 deg",
}
_NO_IMAGE = (OSError, ValueError, SyntaxError, LookupError, EOFError, OverflowError, struct.error)


def read_image(path: Path | str) -> Image:
    """Read an image of 8 or 16 bits as grey; colour gives its luminance.

    Parameters
    ----------
    path
        A file that OpenCV reads, such as PNG or TIFF.

    Returns
    -------
    Image
        (height, width), [row, column], uint8 or uint16.

    Raises
    ------
    DetectionError
        When it cannot be read, has another type or shape, or is too large.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise DetectionError(f"{path}: cannot be read ({error.strerror})") from error
    fault = _find_fault(data)
    if fault:
        raise DetectionError(f"{path}: {fault}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise DetectionError(f"{path}: not an image, or damaged")
    try:
        return convert_to_grey(image)  # pyright: ignore[reportArgumentType] - checked there
    except ValueError as error:
        raise DetectionError(f"{path}: {error}") from error


def _describe_orientation(orientation: int) -> str:
    """Return what an EXIF orientation says against reading the pixels as they are stored, "" when it is upright or
    unknown."""
    if orientation <= _UPRIGHT or orientation > max(_TURNS):
        return ""
    return (
        f"its EXIF orientation says it is to be shown {_TURNS[orientation]}, so that its coordinates would not be "
        "those of the camera's pixels: take the tag out (exiftool -Orientation= FILE), or turn the pixels"
    )


def _find_fault(data: bytes) -> str:
    """Return what its header says against reading it, "" when nothing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of what is below our limit
            with PIL.Image.open(io.BytesIO(data)) as image:  # which decodes nothing yet
                if fault := describe_size_fault(*image.size):
                    return f"{fault} (--max-megapixels)"
                return _describe_orientation(int(image.getexif().get(_ORIENTATION, _UPRIGHT)))
    except PIL.Image.DecompressionBombError:
        return "claims far more pixels than any camera has"
    except _NO_IMAGE:
        return "not an image, or damaged"
