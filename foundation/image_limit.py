"""How large an image may be. A file of some kB can claim pixels that fill any memory; its header says how many."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar

# An array of floats of it has 280 MB, so that a command stays below 1.5 GB; `compensate detect --max-megapixels` lifts
# it.
GREATEST_MEGAPIXELS = 70.0
_greatest_megapixels = ContextVar("greatest_megapixels", default=GREATEST_MEGAPIXELS)


@contextmanager
def allow_images_up_to(megapixels: float) -> Generator[None]:
    """Inside, images of so many million pixels are read."""
    before = _greatest_megapixels.set(megapixels)
    try:
        yield
    finally:
        _greatest_megapixels.reset(before)


def describe_size_fault(width_px: int, height_px: int) -> str:
    """Return what is wrong with an image of that size, "" when it can be read."""
    greatest = _greatest_megapixels.get()
    if width_px > 0 and height_px > 0 and width_px * height_px <= greatest * 1e6:
        return ""
    return f"claims {width_px} x {height_px} px; up to {greatest:g} megapixels are read"
