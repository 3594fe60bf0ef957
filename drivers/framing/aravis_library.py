"""libaravis, GObject and GLib through ctypes: loading, signatures, GError.

Signatures follow the Aravis 0.8 reference manual; each one is declared, or ctypes would cut pointers to 32 bits.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from thermostand.foundation.errors import StandError

ARAVIS_SONAMES = ("libaravis-0.8.so.0", "libaravis-0.10.so.0")
DEVICE_ERRORS = "arv-device-error-quark"
GENICAM_ERRORS = "arv-gc-error-quark"

# "result arguments": P pointer, S string, i int, u unsigned int, I int64, U uint64, d double, z size_t, b gboolean,
# L unsigned long, v void, * pointer to what the caller provides, E trailing GError**.
ARAVIS_FUNCTIONS = {
    "arv_camera_new": "P SE",
    "arv_camera_get_device": "P P",
    "arv_camera_create_stream": "P PPPE",
    "arv_camera_start_acquisition": "v PE",
    "arv_camera_stop_acquisition": "v PE",
    "arv_camera_get_float": "d PSE",
    "arv_camera_get_float_bounds": "v PS**E",
    "arv_camera_get_integer": "I PSE",
    "arv_camera_execute_command": "v PSE",
    "arv_camera_set_float": "v PSdE",
    "arv_camera_set_integer": "v PSIE",
    "arv_camera_get_integer_bounds": "v PS**E",
    "arv_camera_get_string": "S PSE",
    "arv_camera_set_string": "v PSSE",
    "arv_camera_set_boolean": "v PSbE",
    "arv_camera_is_feature_available": "b PSE",
    "arv_camera_dup_available_enumerations_as_strings": "P PS*E",
    "arv_camera_is_gv_device": "b P",
    "arv_camera_gv_set_stream_options": "v Pi",
    "arv_camera_gv_set_packet_size_adjustment": "v Pi",
    "arv_camera_gv_set_packet_size": "v PiE",
    "arv_camera_gv_get_packet_size": "u PE",
    "arv_camera_gv_auto_packet_size": "u PE",
    "arv_device_get_feature": "P PS",
    "arv_dom_node_get_node_name": "S P",
    "arv_device_get_type": "z ",
    "arv_gc_new": "P PSz",
    "arv_gc_get_node": "P PS",
    "arv_gc_feature_node_is_implemented": "b PE",
    "arv_gc_integer_get_value": "I PE",
    "arv_gc_integer_set_value": "v PIE",
    "arv_gc_float_get_value": "d PE",
    "arv_gc_float_set_value": "v PdE",
    "arv_gc_boolean_get_value": "b PE",
    "arv_gc_boolean_set_value": "v PbE",
    "arv_gc_enumeration_get_int_value": "I PE",
    "arv_gc_enumeration_get_string_value": "S PE",
    "arv_gc_enumeration_set_string_value": "v PSE",
    "arv_gc_register_get_address": "U PE",
    "arv_gc_register_get_length": "U PE",
    "arv_gc_float_get_unit": "S P",
    "arv_gc_integer_get_unit": "S P",
    "arv_device_read_register": "b PU*E",
    "arv_device_write_register": "b PUuE",
    "arv_device_read_memory": "b PUu*E",
    "arv_gv_device_is_controller": "b P",
    "arv_stream_push_buffer": "v PP",
    "arv_stream_timeout_pop_buffer": "P PU",
    "arv_stream_try_pop_buffer": "P P",
    "arv_stream_get_n_infos": "u P",
    "arv_stream_get_info_name": "S Pu",
    "arv_stream_get_info_uint64_by_name": "U PS",
    "arv_buffer_new_allocate": "P z",
    "arv_buffer_get_status": "i P",
    "arv_buffer_get_frame_id": "U P",
    "arv_buffer_get_timestamp": "U P",
    "arv_buffer_get_data": "P P*",
    "arv_buffer_get_image_width": "i P",
    "arv_buffer_get_image_height": "i P",
}
GOBJECT_FUNCTIONS = {
    "g_object_unref": "v P",
    "g_object_new": "P zP",
    "g_object_set_property": "v PS*",
    "g_type_query": "v z*",
    "g_type_register_static_simple": "z zSuPuPu",
    "g_value_init": "P *L",
    "g_value_set_int": "v *i",
    "g_value_set_uint": "v *u",
    "g_value_set_double": "v *d",
    "g_signal_connect_data": "L PSPPPi",
    "g_signal_handler_disconnect": "v PL",
}
GLIB_FUNCTIONS = {"g_free": "v P", "g_error_free": "v P", "g_quark_to_string": "S u"}

C_TYPES: dict[str, Any] = {
    "P": ctypes.c_void_p,
    "S": ctypes.c_char_p,
    "i": ctypes.c_int,
    "u": ctypes.c_uint,
    "I": ctypes.c_int64,
    "U": ctypes.c_uint64,
    "d": ctypes.c_double,
    "z": ctypes.c_size_t,
    "b": ctypes.c_int,
    "L": ctypes.c_ulong,
    "*": ctypes.c_void_p,
    "v": None,
    "E": ctypes.c_void_p,
}


class AravisError(Exception):
    """What a call reported as GError: its domain (a quark's name), code and message."""

    def __init__(self, domain: str, code: int, message: str) -> None:
        super().__init__(message)
        self.domain = domain
        self.code = code


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int32), ("message", ctypes.c_char_p))


def load(sonames: tuple[str, ...], debian_package: str) -> ctypes.CDLL:
    """The first of the libraries that is there; StandError names the package to install when none is."""
    for soname in sonames:
        try:
            return ctypes.CDLL(soname)
        except OSError:
            continue
    raise StandError(f"{sonames[0]} cannot be loaded; on Debian or Ubuntu: apt-get install {debian_package}")


Functions = Mapping[str, Callable[..., Any]]
"""By name, as ctypes has them; what a function reports as GError is raised as AravisError.

A function may return a value and report an error: the error decides.
"""


def _declare(library: ctypes.CDLL, signatures: dict[str, str]) -> Iterator[tuple[str, Callable[..., Any]]]:
    for name, signature in signatures.items():
        result, _, arguments = signature.partition(" ")
        function = getattr(library, name)
        function.restype = C_TYPES[result]
        function.argtypes = [C_TYPES[letter] for letter in arguments]
        yield name, function


def _wrap_errors(function: Callable[..., Any], glib: Functions) -> Callable[..., Any]:
    """`function` with its GError, which is its last argument, raised and freed."""

    def call(*arguments: object) -> Any:
        reported = ctypes.POINTER(_GError)()
        result = function(*arguments, ctypes.byref(reported))
        if not reported:
            return result
        domain = glib["g_quark_to_string"](reported.contents.domain) or b""
        message = reported.contents.message or b"no message"
        error = AravisError(domain.decode(), reported.contents.code, message.decode(errors="replace"))
        glib["g_error_free"](reported)
        raise error

    return call


@functools.cache
def load_library() -> Functions:
    """Aravis, GObject and GLib, loaded once; StandError names the package of a missing one."""
    glib = dict(_declare(load(("libglib-2.0.so.0",), "libglib2.0-0"), GLIB_FUNCTIONS))
    gobject = _declare(load(("libgobject-2.0.so.0",), "libglib2.0-0"), GOBJECT_FUNCTIONS)
    aravis = _declare(load(ARAVIS_SONAMES, "libaravis-0.8-0"), ARAVIS_FUNCTIONS)
    reporting = {name for name, signature in ARAVIS_FUNCTIONS.items() if signature.endswith("E")}
    calls = {name: _wrap_errors(function, glib) if name in reporting else function for name, function in aravis}
    return {**calls, **dict(gobject), **glib}
