from collections.abc import Iterator

import pytest

from tests.stock_camera import run_stock_camera


@pytest.fixture(scope="session")
def stock_camera() -> Iterator[None]:
    """The stock Aravis fake camera answers at its address."""
    yield from run_stock_camera()
