import os

import pytest

from thermostand.drivers.framing.aravis_library import DEVICE_ERRORS, AravisError, Functions, load, load_library
from thermostand.drivers.wires.aravis import GigeDevice
from thermostand.foundation.errors import StandError


@pytest.fixture
def aravis() -> Functions:
    try:
        return load_library()
    except StandError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


def test_a_missing_library_names_the_package_to_install():
    with pytest.raises(StandError, match=r"^libnowhere\.so\.1 cannot be loaded.*apt-get install libnowhere1$"):
        load(("libnowhere.so.1", "libnowhere.so.2"), "libnowhere1")


def test_the_first_installed_library_is_taken():
    assert load(("libnowhere.so.1", "libc.so.6"), "libc6")


def test_every_declared_function_exists(aravis: Functions):
    assert aravis["g_quark_to_string"](0) is None


def test_what_aravis_reports_becomes_an_exception_with_domain_and_code(aravis: Functions):
    with pytest.raises(AravisError, match=r"'no such camera'") as caught:
        GigeDevice("no such camera")
    assert (caught.value.domain, caught.value.code) == (DEVICE_ERRORS, 6)
