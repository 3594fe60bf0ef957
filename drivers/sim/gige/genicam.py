"""The camera's features: one table, from which both the GenICam XML and the register memory are made.

Names follow the SFNC (Standard Features Naming Convention 2.x), addresses below 0x1000 are the bootstrap registers of
GigE Vision, those from 0x10000 on are our own. All registers are big endian.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import KW_ONLY, dataclass
from typing import Literal

from thermostand.drivers.sim.gige.gvsp import PixelFormat

XML_ADDRESS = 0x40000
XML_NAME = "thermostand_camera.xml"
VENDOR = "Thermostand"
MODEL = "Simulated 5M"
VERSION = "1.0"

TICKS_PER_S = 1_000_000_000
MAX_RATE_Hz = 14.0

FeatureKind = Literal["integer", "float", "string", "enumeration", "boolean", "command"]
Entries = tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Feature:
    """One feature and its register.

    `category` None: a register without a node. `lsb` and `bits`: the field inside the register, bit 0 the least
    significant (the XML counts from the other end). `headroom` (a, b): the maximum is the value of a less that of b.
    `locked`: refused while TLParamsLocked is 1. A command is never stored: it always reads 0.
    """

    name: str
    kind: FeatureKind
    address: int
    category: str | None
    access: Literal["RO", "RW"] = "RW"
    default: float | str = 0
    _: KW_ONLY
    minimum: float = 0
    maximum: float = 0xFFFFFFFF
    increment: int = 1
    unit: str = ""
    entries: Entries = ()
    length: int = 4
    lsb: int = 0
    bits: int = 0
    headroom: tuple[str, str] | None = None
    locked: bool = False
    selects: tuple[str, ...] = ()

    @property
    def masked(self) -> bool:
        """The feature is a field of its register, not all of it."""
        return self.bits > 0


def make_features(width: int, height: int, serial: str, stream_port: int = 0) -> tuple[Feature, ...]:
    """The table of a camera with a sensor of width x height px; defaults are the user set after power-on.

    `stream_port` is the UDP port that its stream comes from.
    """
    return (*_device(serial), *_image(width, height), *_acquisition(), *_transport(width * height, stream_port))


def _text(name: str, address: int, length: int, default: str, access: Literal["RO", "RW"] = "RO") -> Feature:
    return Feature(name, "string", address, "DeviceControl", access, default, length=length)


def _enumeration(name: str, address: int, category: str, entries: Entries, selects: tuple[str, ...] = ()) -> Feature:
    """An enumeration; its first entry is the default."""
    return Feature(name, "enumeration", address, category, default=entries[0][1], entries=entries, selects=selects)


def _device(serial: str) -> tuple[Feature, ...]:
    return (
        _text("DeviceVendorName", 0x0048, 32, VENDOR),
        _text("DeviceModelName", 0x0068, 32, MODEL),
        _text("DeviceVersion", 0x0088, 32, VERSION),
        _text("DeviceManufacturerInfo", 0x00A8, 48, "simulated laboratory"),
        _text("DeviceSerialNumber", 0x00D8, 16, serial),
        _text("DeviceUserID", 0x00E8, 16, "", "RW"),
        _enumeration(
            "DeviceTemperatureSelector",
            0x10000,
            "DeviceControl",
            (("Sensor", 0), ("Mainboard", 1)),
            selects=("DeviceTemperature",),
        ),
        Feature(
            "DeviceTemperature",
            "float",
            0x10008,
            "DeviceControl",
            "RO",
            0.0,
            minimum=-60.0,
            maximum=150.0,
            unit="C",
            length=8,
        ),
        Feature("DeviceReset", "command", 0x10010, "DeviceControl"),
    )


def _image(width: int, height: int) -> tuple[Feature, ...]:
    def size(name: str, address: int, default: int, access: Literal["RO", "RW"] = "RO") -> Feature:
        return Feature(name, "integer", address, "ImageFormatControl", access, default, unit="px")

    def region(name: str, address: int, default: int, minimum: int, step: int, headroom: tuple[str, str]) -> Feature:
        return Feature(
            name,
            "integer",
            address,
            "ImageFormatControl",
            default=default,
            minimum=minimum,
            increment=step,
            unit="px",
            headroom=headroom,
            locked=True,
        )

    return (
        size("SensorWidth", 0x10100, width),
        size("SensorHeight", 0x10104, height),
        size("WidthMax", 0x10108, width),
        size("HeightMax", 0x1010C, height),
        region("Width", 0x10110, width, 16, 4, ("WidthMax", "OffsetX")),
        region("Height", 0x10114, height, 16, 2, ("HeightMax", "OffsetY")),
        region("OffsetX", 0x10118, 0, 0, 4, ("WidthMax", "Width")),
        region("OffsetY", 0x1011C, 0, 0, 2, ("HeightMax", "Height")),
        Feature(
            "PixelFormat",
            "enumeration",
            0x10120,
            "ImageFormatControl",
            default=PixelFormat.MONO8,
            entries=tuple((each.symbol, each) for each in PixelFormat),
            locked=True,
        ),
    )


def _acquisition() -> tuple[Feature, ...]:
    acquisition, analog = "AcquisitionControl", "AnalogControl"
    trigger = ("TriggerMode", "TriggerSource", "TriggerActivation", "TriggerSoftware")
    return (
        Feature(
            "AcquisitionMode",
            "enumeration",
            0x10200,
            acquisition,
            entries=(("Continuous", 0), ("SingleFrame", 1)),
            locked=True,
        ),
        Feature("AcquisitionStart", "command", 0x10204, acquisition),
        Feature("AcquisitionStop", "command", 0x10208, acquisition),
        Feature("AcquisitionFrameRateEnable", "boolean", 0x1020C, acquisition, maximum=1),
        Feature(
            "AcquisitionFrameRate",
            "float",
            0x10210,
            acquisition,
            "RW",
            10.0,
            minimum=0.01,
            maximum=MAX_RATE_Hz,
            unit="Hz",
            length=8,
        ),
        _enumeration("TriggerSelector", 0x10218, acquisition, (("FrameStart", 0),), selects=trigger),
        _enumeration("TriggerMode", 0x1021C, acquisition, (("Off", 0), ("On", 1))),
        _enumeration("TriggerSource", 0x10220, acquisition, (("Software", 0), ("Line0", 1))),
        _enumeration("TriggerActivation", 0x10224, acquisition, (("RisingEdge", 0), ("FallingEdge", 1))),
        Feature("TriggerSoftware", "command", 0x10228, acquisition),
        _enumeration("ExposureMode", 0x1022C, acquisition, (("Timed", 0),)),
        _enumeration("ExposureAuto", 0x10230, acquisition, (("Off", 0),)),
        Feature(
            "ExposureTime",
            "float",
            0x10238,
            acquisition,
            "RW",
            10_000.0,
            minimum=20.0,
            maximum=10e6,
            unit="us",
            length=8,
        ),
        _enumeration("GainAuto", 0x10240, analog, (("Off", 0),)),
        Feature("Gain", "float", 0x10248, analog, "RW", 0.0, maximum=24.0, unit="dB", length=8),
    )


def _transport(payload_bytes: int, stream_port: int) -> tuple[Feature, ...]:
    transport = "TransportLayerControl"
    return (
        Feature("PayloadSize", "integer", 0x10300, transport, "RO", payload_bytes, unit="B"),
        Feature("TLParamsLocked", "integer", 0x10304, transport, maximum=1),
        Feature(
            "GevHeartbeatTimeout", "integer", 0x0938, transport, "RW", 3000, minimum=500, maximum=60_000, unit="ms"
        ),
        Feature(
            "GevTimestampTickFrequency",
            "integer",
            0x093C,
            transport,
            "RO",
            TICKS_PER_S,
            maximum=2**63 - 1,
            unit="Hz",
            length=8,
        ),
        Feature("GevTimestampControlReset", "command", 0x0944, transport, lsb=0, bits=1),
        Feature("GevTimestampControlLatch", "command", 0x0944, transport, lsb=1, bits=1),
        Feature("GevTimestampValue", "integer", 0x0948, transport, "RO", maximum=2**63 - 1, unit="ns", length=8),
        Feature("GevCCP", "integer", 0x0A00, None),
        Feature("GevSCPHostPort", "integer", 0x0D00, transport, maximum=0xFFFF, lsb=0, bits=16),
        Feature(
            "GevSCPSPacketSize",
            "integer",
            0x0D04,
            transport,
            "RW",
            1500,
            minimum=220,
            maximum=16112,
            increment=4,
            unit="B",
            bits=16,
            locked=True,
        ),
        Feature("GevSCPSDoNotFragment", "boolean", 0x0D04, transport, maximum=1, lsb=30, bits=1),
        Feature("GevSCPSFireTestPacket", "command", 0x0D04, transport, lsb=31, bits=1),
        Feature("GevSCPD", "integer", 0x0D08, transport, maximum=10_000_000, unit="ns"),
        Feature("GevSCDA", "integer", 0x0D18, transport),
        Feature("GevSCSP", "integer", 0x0D1C, transport, "RO", stream_port, maximum=0xFFFF),
    )


# ------------------------------------------------------------------------------------------------------------ the XML


def to_xml(table: tuple[Feature, ...]) -> bytes:
    """The GenICam description (schema 1.1) of the features that have a category."""
    root = ET.Element(
        "RegisterDescription",
        {
            "ModelName": "Simulated5M",
            "VendorName": VENDOR,
            "ToolTip": "Camera of the simulated laboratory",
            "StandardNameSpace": "GEV",
            "SchemaMajorVersion": "1",
            "SchemaMinorVersion": "1",
            "SchemaSubMinorVersion": "0",
            "MajorVersion": "1",
            "MinorVersion": "0",
            "SubMinorVersion": "0",
            "ProductGuid": "5C1B6E0C-6E0B-4C4B-8B52-27C8A3B5F001",
            "VersionGuid": "5C1B6E0C-6E0B-4C4B-8B52-27C8A3B5F002",
            "xmlns": "http://www.genicam.org/GenApi/Version_1_1",
        },
    )
    shown = [feature for feature in table if feature.category is not None]
    categories = list(dict.fromkeys(str(feature.category) for feature in shown))
    _category(root, "Root", categories)
    for category in categories:
        _category(root, category, [feature.name for feature in shown if feature.category == category])
    for feature in shown:
        _add_nodes(root, feature)
    port = ET.SubElement(root, "Port", Name="Device", NameSpace="Standard")
    _add_leaves(port, ("Visibility", "Invisible"))
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def _category(root: ET.Element, name: str, members: list[str]) -> None:
    category = ET.SubElement(root, "Category", Name=name, NameSpace="Standard")
    _add_leaves(category, *(("pFeature", member) for member in members))


def _add_leaves(node: ET.Element, *pairs: tuple[str, object]) -> None:
    for tag, value in pairs:
        ET.SubElement(node, tag).text = str(value)


def _add_nodes(root: ET.Element, feature: Feature) -> None:
    """The feature's node and that of its register; a string is its own register."""
    if feature.kind == "string":
        _register(ET.SubElement(root, "StringReg", Name=feature.name, NameSpace="Standard"), feature)
        return
    tag = {"integer": "Integer", "float": "Float", "enumeration": "Enumeration"}.get(
        feature.kind, feature.kind.capitalize()
    )
    node = ET.SubElement(root, tag, Name=feature.name, NameSpace="Standard")
    if feature.locked:
        _add_leaves(node, ("pIsLocked", "TLParamsLocked"))
    for symbol, value in feature.entries:
        entry = ET.SubElement(node, "EnumEntry", Name=symbol, NameSpace="Standard")
        _add_leaves(entry, ("Value", int(value)))
    _add_leaves(node, ("pValue", f"{feature.name}Reg"))
    if feature.kind in ("integer", "float"):
        _range(root, node, feature)
    elif feature.kind == "command":
        _add_leaves(node, ("CommandValue", 1))
    elif feature.kind == "boolean":
        _add_leaves(node, ("OnValue", 1), ("OffValue", 0))
    _add_leaves(node, *(("pSelected", name) for name in feature.selects))
    _register_node(root, feature)


def _range(root: ET.Element, node: ET.Element, feature: Feature) -> None:
    _add_leaves(node, ("Min", feature.minimum))
    if feature.headroom is None:
        _add_leaves(node, ("Max", feature.maximum))
    else:
        whole, used = feature.headroom
        knife = ET.SubElement(root, "IntSwissKnife", Name=f"{feature.name}MaxExpr")
        for variable, name in (("WHOLE", whole), ("USED", used)):
            ET.SubElement(knife, "pVariable", Name=variable).text = name
        _add_leaves(knife, ("Formula", "WHOLE - USED"))
        _add_leaves(node, ("pMax", f"{feature.name}MaxExpr"))
    if feature.kind == "integer":
        _add_leaves(node, ("Inc", feature.increment))
    if feature.unit:
        _add_leaves(node, ("Unit", feature.unit))


def _register_node(root: ET.Element, feature: Feature) -> None:
    tag = "FloatReg" if feature.kind == "float" else "MaskedIntReg" if feature.masked else "IntReg"
    node = ET.SubElement(root, tag, Name=f"{feature.name}Reg", NameSpace="Custom")
    _register(node, feature)
    if feature.masked:  # the XML numbers the bits of a big-endian register from the most significant one
        _add_leaves(node, ("LSB", 31 - feature.lsb), ("MSB", 31 - feature.lsb - feature.bits + 1))
    if feature.kind != "float":
        _add_leaves(node, ("Sign", "Unsigned"))
    _add_leaves(node, ("Endianess", "BigEndian"))


def _register(node: ET.Element, feature: Feature) -> None:
    _add_leaves(
        node,
        ("Address", f"{feature.address:#x}"),
        ("Length", feature.length),
        ("AccessMode", feature.access),
        ("pPort", "Device"),
        ("Cachable", "NoCache"),
    )
