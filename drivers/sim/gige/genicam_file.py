"""A camera's own GenICam file: its nodes, and which registers a node's value is made of.

Only the structure is read here; values, converters and SwissKnives are evaluated by Aravis (genicam_memory.py).
"""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

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
        if circular := self._circular():
            raise ConfigError(f"{what} cannot be evaluated: the value of its {circular} is made of itself")
        for name in filter(lambda each: self.kind(each) in _NUMBERS, self._nodes):
            length = self.named(name, "Length")
            if length and not 1 <= _integer(length) <= _LONGEST_bytes:
                raise ConfigError(f"{what} cannot be evaluated: its {name} has the Length {length}, not 1 to 8 bytes")

    def _circular(self) -> str:
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
                    ahead += [(each, False) for each in self._made_of(name, _EVALUATED)]
        return ""

    def _made_of(self, name: str, properties: frozenset[str]) -> Iterator[str]:
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

    def named(self, name: str, property_name: str) -> str:
        """The node that a property such as pMax or pValue names; "" when the node has no such property."""
        return next((child.text or "" for child in self._nodes[name] if _tag(child) == property_name), "").strip()

    def entries(self, name: str) -> dict[str, tuple[str, ...]]:
        """An enumeration's entries, each with the nodes that say whether it is there."""
        return {entry.get("Name", ""): _conditions(entry) for entry in self._nodes[name] if _tag(entry) == "EnumEntry"}

    def conditions(self, name: str) -> Iterator[str]:
        """The nodes that say whether a node is there, and whether what its value is made of is."""
        for each in self.reached(name):
            yield from _conditions(self._nodes[each])

    def registers(self, name: str) -> tuple[str, ...]:
        """The registers that a node's value is made of, nearest first."""
        return tuple(each for each in self.reached(name) if self.kind(each) in REGISTERS)

    def written(self, name: str) -> tuple[str, ...]:
        """The registers that writing a node may write: which one a selector says."""
        return tuple(each for each in self.reached(name, _WRITTEN) if self.kind(each) in REGISTERS)

    def reached(self, name: str, properties: frozenset[str] = _MADE_OF) -> list[str]:
        """The node, and all that its value is made of, nearest first."""
        reached = [name]
        for each in reached:
            reached += [other for other in dict.fromkeys(self._made_of(each, properties)) if other not in reached]
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
    return GenicamFile(_unzipped(text, path) if text.startswith(_ZIP) else text, str(path))


def _unzipped(data: bytes, path: Path) -> bytes:
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
    """Whether a name in an archive is an XML file's; what macOS adds to each file begins with a dot."""
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
