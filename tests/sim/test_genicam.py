import itertools
import struct
import xml.etree.ElementTree as ET

import pytest

from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.camera_registers import Registers
from thermostand.drivers.sim.gige.genicam import Feature, make_features, to_xml

SPACE = "{http://www.genicam.org/GenApi/Version_1_1}"
TABLE = make_features(64, 48, "SN1")
BY_NAME = {feature.name: feature for feature in TABLE}
REFERENCES = ("pFeature", "pValue", "pMax", "pSelected", "pVariable", "pIsLocked", "pPort")


@pytest.fixture(scope="module")
def root() -> ET.Element:
    return ET.fromstring(to_xml(TABLE))


@pytest.fixture
def registers() -> Registers:
    return Registers(TABLE, "127.0.0.71", "SN1")


def node(root: ET.Element, name: str) -> ET.Element:
    return next(child for child in root if child.get("Name") == name)


def test_the_schema_is_1_1(root: ET.Element) -> None:
    assert [root.get(f"Schema{part}Version") for part in ("Major", "Minor", "SubMinor")] == ["1", "1", "0"]


def test_node_names_are_unique_and_every_reference_leads_to_a_node(root: ET.Element) -> None:
    names = [child.get("Name") for child in root]
    assert len(names) == len(set(names))
    targets = {element.text for tag in REFERENCES for element in root.iter(SPACE + tag)}
    assert targets <= set(names)


def test_every_shown_feature_is_reached_from_the_root(root: ET.Element) -> None:
    def members(category: str) -> list[str]:
        return [str(feature.text) for feature in node(root, category)]

    reached = [name for category in members("Root") for name in members(category)]
    assert reached == [feature.name for feature in TABLE if feature.category is not None]


def test_registers_overlap_only_as_fields_of_one_word() -> None:
    for one, other in itertools.combinations(TABLE, 2):
        overlap = one.address < other.address + other.length and other.address < one.address + one.length
        if overlap:
            assert one.address == other.address
            assert bits(one) & bits(other) == 0


def bits(feature: Feature) -> int:
    return ((1 << (feature.bits or 32)) - 1) << feature.lsb


def test_fields_are_numbered_from_the_most_significant_bit_in_the_xml(root: ET.Element) -> None:
    packet_size = node(root, "GevSCPSPacketSizeReg")
    assert (packet_size.findtext(SPACE + "LSB"), packet_size.findtext(SPACE + "MSB")) == ("31", "16")
    fire = node(root, "GevSCPSFireTestPacketReg")
    assert (fire.findtext(SPACE + "LSB"), fire.findtext(SPACE + "MSB")) == ("0", "0")


def test_the_xml_is_found_through_its_url_in_the_memory(registers: Registers) -> None:
    url = registers.read(0x200, 512).split(b"\0")[0].decode()
    place, address, length = url.split(";")
    assert place.startswith("Local:")
    assert registers.read(int(address, 16), int(length, 16)) == to_xml(TABLE)


def test_after_reset_every_feature_has_a_legal_default(registers: Registers) -> None:
    for feature in TABLE:
        if feature.kind in ("string", "command"):
            continue
        value = registers.real(feature.name) if feature.kind == "float" else registers.integer(feature.name)
        assert value == feature.default
        if feature.entries:
            assert value in [number for _, number in feature.entries]
        elif feature.headroom is None:
            assert feature.minimum <= value <= feature.maximum


def write(registers: Registers, name: str, value: int) -> tuple[str, ...]:
    return registers.write(BY_NAME[name].address, value.to_bytes(4, "big"))


def test_a_write_tells_what_changed_and_reset_undoes_it(registers: Registers) -> None:
    assert write(registers, "Width", 32) == ("Width",)
    assert write(registers, "Width", 32) == ()
    assert registers.integer("Width") == 32
    registers.reset()
    assert registers.integer("Width") == 64


def test_a_command_is_reported_every_time_and_reads_zero(registers: Registers) -> None:
    assert write(registers, "AcquisitionStart", 1) == ("AcquisitionStart",)
    assert write(registers, "AcquisitionStart", 1) == ("AcquisitionStart",)
    assert registers.read(BY_NAME["AcquisitionStart"].address, 4) == bytes(4)


def test_the_fields_of_the_packet_size_register_do_not_disturb_each_other(registers: Registers) -> None:
    changed = registers.write(0x0D04, (1 << 31 | 1 << 30 | 8000).to_bytes(4, "big"))
    assert changed == ("GevSCPSPacketSize", "GevSCPSDoNotFragment", "GevSCPSFireTestPacket")
    assert registers.integer("GevSCPSPacketSize") == 8000
    assert registers.read(0x0D04, 4) == (1 << 30 | 8000).to_bytes(4, "big")


def test_the_region_must_fit_the_sensor(registers: Registers) -> None:
    write(registers, "Width", 32)
    assert write(registers, "OffsetX", 32) == ("OffsetX",)
    for name, value in (("OffsetX", 36), ("Width", 36), ("OffsetX", 2), ("Width", 12)):
        with pytest.raises(gvcp.Nack) as refused:
            write(registers, name, value)
        assert refused.value.status == gvcp.GvcpStatus.BAD_PARAMETER
    assert (registers.integer("OffsetX"), registers.integer("Width")) == (32, 32)


@pytest.mark.parametrize("value", [19.0, 1.1e7, float("nan"), float("inf")])
def test_an_exposure_out_of_range_is_refused(registers: Registers, value: float) -> None:
    with pytest.raises(gvcp.Nack) as refused:
        registers.write(BY_NAME["ExposureTime"].address, struct.pack(">d", value))
    assert refused.value.status == gvcp.GvcpStatus.BAD_PARAMETER
    assert registers.real("ExposureTime") == 10_000.0


@pytest.mark.parametrize("name", ["Width", "PixelFormat", "GevSCPSPacketSize"])
def test_what_shapes_the_stream_is_locked_while_streaming(registers: Registers, name: str) -> None:
    registers.put("TLParamsLocked", 1)
    with pytest.raises(gvcp.Nack) as refused:
        write(registers, name, 0x01100005 if name == "PixelFormat" else 512)
    assert refused.value.status == gvcp.GvcpStatus.ACCESS_DENIED


@pytest.mark.parametrize(
    ("address", "data", "status"),
    [
        (0x10300, bytes(4), gvcp.GvcpStatus.WRITE_PROTECT),  # PayloadSize
        (0x40000, bytes(4), gvcp.GvcpStatus.WRITE_PROTECT),  # the XML
        (0x0934, bytes(4), gvcp.GvcpStatus.WRITE_PROTECT),  # the capability register
        (0x90000, bytes(4), gvcp.GvcpStatus.BAD_ADDRESS),
        (0x10238, bytes(4), gvcp.GvcpStatus.BAD_ADDRESS),  # half an ExposureTime
        (0x00E8, bytes(20), gvcp.GvcpStatus.BAD_PARAMETER),  # a user ID that is too long
        (0x10120, b"\1\2\3\4", gvcp.GvcpStatus.BAD_PARAMETER),  # no pixel format
    ],
)
def test_a_write_that_makes_no_sense_is_refused(
    registers: Registers, address: int, data: bytes, status: gvcp.GvcpStatus
) -> None:
    with pytest.raises(gvcp.Nack) as refused:
        registers.write(address, data)
    assert refused.value.status == status


def test_the_user_name_is_padded_with_zeros(registers: Registers) -> None:
    assert registers.write(0x00E8, b"left") == ("DeviceUserID",)
    assert registers.read(0x00E8, 16) == b"left".ljust(16, b"\0")


def test_a_read_beyond_the_memory_is_refused(registers: Registers) -> None:
    for address, count in ((0x0FFC, 8), (0x20000, 4)):
        with pytest.raises(gvcp.Nack) as refused:
            registers.read(address, count)
        assert refused.value.status == gvcp.GvcpStatus.BAD_ADDRESS
