"""A camera's own GenICam file: its nodes, and which registers a node's value is made of.

Only the structure is read here; values, converters and SwissKnives are evaluated by Aravis (genicam_memory.py).
"""

from __future__ import annotations

import ctypes
import functools
import io
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from thermostand.drivers.framing.aravis_library import AravisError, load_library
from thermostand.foundation.errors import ConfigError

LARGEST_bytes = 16 << 20  # ten times the largest of 27 makes and models
_ZIP = b"PK\x03\x04"
REGISTERS = frozenset({"IntReg", "MaskedIntReg", "FloatReg", "StructEntry"})
_NUMBERS, _LONGEST_bytes = frozenset({"IntReg", "MaskedIntReg", "FloatReg", "StructReg"}), 8

# What a node's value follows from: its own value, and the variables of a formula.
_WRITTEN = frozenset({"pValue", "pValueIndexed", "pValueDefault"})
_MADE_OF = _WRITTEN | {"pVariable"}
_EVALUATED = _MADE_OF | {"pAddress", "pIndex", "pLength"}
_NOT_A_NODE = frozenset({"EnumEntry", "pVariable", "Constant", "Expression"})


class GenicamFile:
    """The file's text as a camera serves it, and its nodes by name. ConfigError when it is none."""

    def __init__(self, text: bytes, what: str) -> None:
        begin = text.find(b"<")  # arv-tool writes the camera's name in front
        self.xml = text[max(begin, 0) :].rstrip()
        try:
            root = ET.fromstring(self.xml)
        except (ET.ParseError, ValueError, LookupError) as error:  # the last: an encoding that nobody knows
            raise ConfigError(f"{what} is no GenICam file: {error}") from error
        if _tag(root) != "RegisterDescription":
            raise ConfigError(f"{what} is no GenICam file: it begins with <{_tag(root)}>, not <RegisterDescription>")
        self.vendor = root.get("VendorName", "")
        self.model = root.get("ModelName", "")
        self._nodes: dict[str, ET.Element] = {}
        for element in root.iter():
            name = element.get("Name")
            if name and _tag(element) not in _NOT_A_NODE:
                self._nodes.setdefault(name, element)
        if circular := self._find_circular_node():
            raise ConfigError(f"{what} cannot be evaluated: the value of its {circular} is made of itself")
        for name in filter(lambda each: self.kind(each) in _NUMBERS, self._nodes):
            length = self.find_named(name, "Length")
            if length and not 1 <= _integer(length) <= _LONGEST_bytes:
                raise ConfigError(f"{what} cannot be evaluated: its {name} has the Length {length}, not 1 to 8 bytes")

    def _find_circular_node(self) -> str:
        """A node whose value is made of itself, over however many others, on which Aravis would crash; "" for none."""
        ended: set[str] = set()
        for start in self._nodes:
            path, ahead = dict[str, None](), [(start, False)]
            while ahead:
                name, is_end = ahead.pop()
                if is_end:
                    del path[name]
                    ended.add(name)
                elif name in path:
                    return name
                elif name not in ended:
                    path[name] = None
                    ahead.append((name, True))
                    ahead += [(each, False) for each in self._iterate_parts(name, _EVALUATED)]
        return ""

    def _iterate_parts(self, name: str, properties: frozenset[str]) -> Iterator[str]:
        """The nodes that properties of a node name."""
        for child in self._nodes[name]:
            if _tag(child) in properties and "." not in child.get("Name", ""):  # a formula's "X.Max" is no value
                target = (child.text or "").strip()
                if target in self._nodes:
                    yield target

    def __contains__(self, name: str) -> bool:
        return name in self._nodes and self.kind(name) != "Category"

    def kind(self, name: str) -> str:
        """The node's kind: Integer, Float, Enumeration, MaskedIntReg, ..."""
        return _tag(self._nodes[name])

    def find_named(self, name: str, property_name: str) -> str:
        """The node that a property such as pMax or pValue names; "" when the node has no such property."""
        return next((child.text or "" for child in self._nodes[name] if _tag(child) == property_name), "").strip()

    def entries(self, name: str) -> dict[str, tuple[str, ...]]:
        """An enumeration's entries, each with the nodes that say whether it is there."""
        return {entry.get("Name", ""): _conditions(entry) for entry in self._nodes[name] if _tag(entry) == "EnumEntry"}

    def conditions(self, name: str) -> Iterator[str]:
        """The nodes that say whether a node is there, and whether what its value is made of is."""
        for each in self.find_reached(name):
            yield from _conditions(self._nodes[each])

    def registers(self, name: str) -> tuple[str, ...]:
        """The registers that a node's value is made of, nearest first."""
        return tuple(each for each in self.find_reached(name) if self.kind(each) in REGISTERS)

    def written(self, name: str) -> tuple[str, ...]:
        """The registers that writing a node may write: which one a selector says."""
        return tuple(each for each in self.find_reached(name, _WRITTEN) if self.kind(each) in REGISTERS)

    def find_reached(self, name: str, properties: frozenset[str] = _MADE_OF) -> list[str]:
        """The node, and all that its value is made of, nearest first."""
        reached = [name]
        for each in reached:
            reached += [other for other in dict.fromkeys(self._iterate_parts(each, properties)) if other not in reached]
        return reached


def read_genicam(path: Path) -> GenicamFile:
    """The file at `path`; ConfigError when it cannot be read or is none."""
    try:
        with path.open("rb") as file:
            text = file.read(LARGEST_bytes + 1)
    except OSError as error:
        raise ConfigError(f"the GenICam file {path} cannot be read: {error.strerror}") from error
    if len(text) > LARGEST_bytes:
        raise ConfigError(f"{path} is no GenICam file: it has more than {LARGEST_bytes >> 20} MB")
    return GenicamFile(_unzip(text, path) if text.startswith(_ZIP) else text, str(path))


def _unzip(data: bytes, path: Path) -> bytes:
    """The XML file in an archive, as many cameras hold theirs."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            files = [each for each in archive.infolist() if _is_description(each.filename)]
            if len(files) != 1:
                raise ConfigError(f"{path} is no GenICam file: an archive with {len(files)} XML files, not one")
            if files[0].file_size > LARGEST_bytes:
                raise ConfigError(f"{path} is no GenICam file: it has more than {LARGEST_bytes >> 20} MB")
            return archive.read(files[0])
    except (zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError) as error:
        raise ConfigError(f"{path} is no GenICam file: an archive that cannot be read ({error})") from error


def _is_description(name: str) -> bool:
    """Return whether a name in an archive is an XML file's; what macOS adds to each file begins with a dot."""
    return name.lower().endswith(".xml") and not name.rpartition("/")[2].startswith(".")


def _integer(text: str) -> int:
    """A number of the file, 0 for none."""
    try:
        return int(text, 0)
    except ValueError:
        return 0


def _tag(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2]


def _conditions(element: ET.Element) -> tuple[str, ...]:
    found = (child for child in element if _tag(child) in ("pIsImplemented", "pIsAvailable"))
    return tuple((child.text or "").strip() for child in found)


# Registers in memory as a GenICam file describes them; Aravis evaluates what stands between them and the features.
#
# Aravis asks a device for bytes at addresses. The device here is a GObject class of our own, made at run time, whose
# memory is a Python object: no socket, no second camera. Class layout: arvdevice.h of Aravis 0.8.


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


class SparseMemory:
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
        """Return what it holds now, for `restore`."""
        return {page: bytearray(held) for page, held in self._pages.items()}

    def restore(self, copy: dict[int, bytearray]) -> None:
        """Set the registers as they were when the copy was made."""
        self._pages = {page: bytearray(held) for page, held in copy.items()}


_MEMORIES: dict[int, SparseMemory] = {}  # by the address of their GObject


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
    functions = load_library()
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


class EvaluatedFile:
    """A file's nodes over a memory; one thread at a time. AravisError where Aravis cannot evaluate a node."""

    def __init__(self, file: GenicamFile) -> None:
        self.file = file
        self.memory = SparseMemory()
        self._library = load_library()
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
        """Return what a Command writes; ConfigError when that is no number."""
        named = self.file.find_named(name, "pCommandValue")
        if named in self.file:
            return round(self.get(named))
        text = named or self.file.find_named(name, "CommandValue") or "0"
        try:
            return int(text, 0)
        except ValueError as error:
            raise ConfigError(f"the GenICam file's {name} has the CommandValue {text!r}, no whole number") from error

    def place(self, register: str) -> tuple[int, int]:
        """Address and length of a register, bytes."""
        node = self._node(register)
        address = self._library["arv_gc_register_get_address"](node)
        return address & _ADDRESS_MASK, self._library["arv_gc_register_get_length"](node)
