"""Registers in memory as a GenICam file describes them; Aravis evaluates what stands between them and the features.

Aravis asks a device for bytes at addresses. The device here is a GObject class of our own, made at run time, whose
memory is a Python object: no socket, no second camera. Class layout: arvdevice.h of Aravis 0.8.
"""

from __future__ import annotations

import ctypes
import functools
from contextlib import suppress
from typing import Any

from thermostand.drivers.framing.aravis_library import AravisError, library
from thermostand.drivers.sim.gige.genicam_file import GenicamFile
from thermostand.foundation.errors import ConfigError

_PAGE_bytes = 4096
_ADDRESS_MASK = 0xFFFFFFFF  # GVCP carries 32 bits of an address, also of a file for USB3 Vision
_FLOATS = frozenset({"Float", "FloatReg", "Converter", "SwissKnife"})

# ArvDeviceClass after its GObjectClass: create_stream, get_genicam_xml, get_genicam, then these.
_READ_SLOT, _WRITE_SLOT = 3, 4
_POINTER_bytes = ctypes.sizeof(ctypes.c_void_p)

_CLASS_INIT = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
_ACCESS = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint32, ctypes.c_void_p, ctypes.c_void_p
)


class _TypeQuery(ctypes.Structure):
    _fields_ = (
        ("type", ctypes.c_size_t),
        ("type_name", ctypes.c_char_p),
        ("class_size", ctypes.c_uint),
        ("instance_size", ctypes.c_uint),
    )


class Memory:
    """Bytes at any address of 64 bits, zero until written."""

    def __init__(self) -> None:
        self._pages: dict[int, bytearray] = {}

    def read(self, address: int, count: int) -> bytes:
        """`count` bytes from `address`."""
        data = bytearray()
        while len(data) < count:
            page, offset = divmod(address + len(data), _PAGE_bytes)
            held = self._pages.get(page) or bytes(_PAGE_bytes)
            data += held[offset : offset + count - len(data)]
        return bytes(data)

    def write(self, address: int, data: bytes) -> None:
        """Bytes from `address` on."""
        written = 0
        while written < len(data):
            page, offset = divmod(address + written, _PAGE_bytes)
            held = self._pages.setdefault(page, bytearray(_PAGE_bytes))
            piece = data[written : written + _PAGE_bytes - offset]
            held[offset : offset + len(piece)] = piece
            written += len(piece)

    def copy(self) -> dict[int, bytearray]:
        """What it holds now, for `restore`."""
        return {page: bytearray(held) for page, held in self._pages.items()}

    def restore(self, copy: dict[int, bytearray]) -> None:
        """As it was when the copy was made."""
        self._pages = {page: bytearray(held) for page, held in copy.items()}


_MEMORIES: dict[int, Memory] = {}  # by the address of their GObject


def _read(device: int, address: int, size: int, buffer: int, _error: int) -> int:
    ctypes.memmove(buffer, _MEMORIES[device].read(address & _ADDRESS_MASK, size), size)
    return 1


def _write(device: int, address: int, size: int, buffer: int, _error: int) -> int:
    _MEMORIES[device].write(address & _ADDRESS_MASK, ctypes.string_at(buffer, size))
    return 1


_READ, _WRITE = _ACCESS(_read), _ACCESS(_write)  # kept for the life of the class


@functools.cache
def _device_type() -> tuple[int, object]:
    """The GType of the device in memory, and what has to live as long as it does."""
    functions = library()
    parent, query, gobject = functions["arv_device_get_type"](), _TypeQuery(), _TypeQuery()
    functions["g_type_query"](parent, ctypes.byref(query))
    functions["g_type_query"](_G_TYPE_OBJECT, ctypes.byref(gobject))

    def initialize(device_class: int, _data: int) -> None:
        first = device_class + gobject.class_size
        for slot, function in ((_READ_SLOT, _READ), (_WRITE_SLOT, _WRITE)):
            pointer = ctypes.cast(function, ctypes.c_void_p).value
            ctypes.c_void_p.from_address(first + slot * _POINTER_bytes).value = pointer

    kept = _CLASS_INIT(initialize)
    made = functions["g_type_register_static_simple"](
        parent,
        b"ThermostandMemoryDevice",
        query.class_size,
        ctypes.cast(kept, ctypes.c_void_p),
        query.instance_size,
        None,
        0,
    )
    return made, kept


_G_TYPE_OBJECT = 20 << 2  # gtype.h


class Evaluated:
    """A file's nodes over a memory; one thread at a time. AravisError where Aravis cannot evaluate a node."""

    def __init__(self, file: GenicamFile) -> None:
        self.file = file
        self.memory = Memory()
        self._library = library()
        self._device = self._library["g_object_new"](_device_type()[0], None)
        _MEMORIES[self._device] = self.memory
        self._xml = file.xml  # Aravis may keep the pointer
        self._genicam = self._library["arv_gc_new"](self._device, self._xml, len(self._xml))
        self._known: dict[str, Any] = {}

    def close(self) -> None:
        """Free Aravis' side."""
        if self._genicam:
            self._library["g_object_unref"](self._genicam)
            self._library["g_object_unref"](self._device)
            del _MEMORIES[self._device]
            self._genicam = None

    def _node(self, name: str) -> Any:
        if name not in self._known:
            self._known[name] = self._library["arv_gc_get_node"](self._genicam, name.encode())
        return self._known[name]

    def get(self, name: str) -> float:
        """A node with a number; an enumeration or a boolean as its value."""
        kind, node = self.file.kind(name), self._node(name)
        if kind in _FLOATS:
            return float(self._library["arv_gc_float_get_value"](node))
        if kind == "Enumeration":
            return float(self._library["arv_gc_enumeration_get_int_value"](node))
        if kind == "Boolean":
            return float(self._library["arv_gc_boolean_get_value"](node))
        return float(self._library["arv_gc_integer_get_value"](node))

    def set(self, name: str, value: float) -> None:
        """Write a node with a number, through its converters."""
        kind, node = self.file.kind(name), self._node(name)
        if kind in _FLOATS:
            self._library["arv_gc_float_set_value"](node, value)
        elif kind == "Boolean":
            self._library["arv_gc_boolean_set_value"](node, bool(value))
        else:
            self._library["arv_gc_integer_set_value"](node, round(value))

    def entry(self, name: str) -> str:
        """The entry that an enumeration has now; "" when it has none of them."""
        with suppress(AravisError):
            return (self._library["arv_gc_enumeration_get_string_value"](self._node(name)) or b"").decode()
        return ""

    def choose(self, name: str, entry: str) -> None:
        """Give an enumeration one of its entries."""
        self._library["arv_gc_enumeration_set_string_value"](self._node(name), entry.encode())

    def command_value(self, name: str) -> int:
        """What a Command writes; ConfigError when that is no number."""
        named = self.file.named(name, "pCommandValue")
        if named in self.file:
            return round(self.get(named))
        text = named or self.file.named(name, "CommandValue") or "0"
        try:
            return int(text, 0)
        except ValueError as error:
            raise ConfigError(f"the GenICam file's {name} has the CommandValue {text!r}, no whole number") from error

    def place(self, register: str) -> tuple[int, int]:
        """Address and length of a register, bytes."""
        node = self._node(register)
        address = self._library["arv_gc_register_get_address"](node)
        return address & _ADDRESS_MASK, self._library["arv_gc_register_get_length"](node)
