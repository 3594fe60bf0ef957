import pytest

from tests.sim.gvcp_client import decode_ack, pack_read_memory, pack_words
from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.camera_registers import CCP, ControlChannel, Registers
from thermostand.drivers.sim.gige.genicam import make_features
from thermostand.drivers.sim.gige.gvcp import Ack, GvcpCommand, GvcpRequest, GvcpStatus, Nack, Resend

ALICE, BOB = ("127.0.0.1", 40001), ("127.0.0.1", 40002)
PACKET_SIZE = 0x0D04
START = 0x10204
TEMPERATURE = 0x10008


class RecordingDevice:
    def __init__(self) -> None:
        self.events: list[object] = []
        self.temperature_readable = True

    def before_read(self, address: int, count: int) -> None:
        if address == TEMPERATURE and not self.temperature_readable:
            raise Nack(GvcpStatus.ACCESS_DENIED, "no temperature")

    def after_write(self, name: str) -> None:
        self.events.append(name)

    def resend(self, resend: Resend) -> None:
        self.events.append(resend)

    def control_ended(self) -> None:
        self.events.append("control ended")


class Wire:
    """A control channel with a request counter and a hand-set clock."""

    def __init__(self) -> None:
        self.device = RecordingDevice()
        self.registers = Registers(make_features(64, 48, "SN1"), "127.0.0.71", "SN1")
        self.channel = ControlChannel(self.registers, self.device)
        self.now_s = 0.0
        self.req_id = 0

    def ask(self, peer: tuple[str, int], command: int, payload: bytes = b"") -> Ack:
        self.req_id += 1
        return decode_ack(self.channel.feed(GvcpRequest(command, self.req_id, payload).encode(), peer, self.now_s))

    def write(self, peer: tuple[str, int], address: int, value: int) -> int:
        return self.ask(peer, GvcpCommand.WRITEREG, pack_words([address, value])).status

    def read(self, peer: tuple[str, int], address: int) -> int:
        (value,) = gvcp.unpack_words(self.ask(peer, GvcpCommand.READREG, pack_words([address])).payload)
        return value


@pytest.fixture
def wire() -> Wire:
    return Wire()


def test_discovery_gives_the_head_of_the_bootstrap_block(wire: Wire) -> None:
    ack = decode_ack(wire.channel.feed(GvcpRequest(GvcpCommand.DISCOVERY, 0xFFFF).encode(), BOB, 0.0))
    assert (ack.req_id, len(ack.payload)) == (0xFFFF, 0xF8)
    assert ack.payload[0x24:0x28] == bytes([127, 0, 0, 71])
    assert ack.payload[0x48:0x58].rstrip(b"\0") == b"Thermostand"
    assert ack.payload[0xD8:0xE8].rstrip(b"\0") == b"SN1"


def test_reads_are_open_to_all_and_writes_only_to_the_controller(wire: Wire) -> None:
    assert wire.write(BOB, PACKET_SIZE, 8000) == GvcpStatus.ACCESS_DENIED
    assert wire.write(ALICE, CCP, 2) == GvcpStatus.OK
    assert wire.write(BOB, PACKET_SIZE, 8000) == GvcpStatus.ACCESS_DENIED
    assert wire.write(BOB, CCP, 2) == GvcpStatus.ACCESS_DENIED
    assert wire.write(BOB, CCP, 0) == GvcpStatus.ACCESS_DENIED
    assert wire.write(ALICE, PACKET_SIZE, 8000) == GvcpStatus.OK
    assert wire.read(BOB, PACKET_SIZE) == 8000
    assert wire.read(BOB, CCP) == 2


def test_giving_up_control_closes_the_stream_and_frees_the_camera(wire: Wire) -> None:
    wire.write(ALICE, CCP, 2)
    wire.write(ALICE, 0x0D00, 50000)
    assert wire.write(ALICE, CCP, 0) == GvcpStatus.OK
    assert wire.device.events == ["GevSCPHostPort", "control ended"]
    assert (wire.read(BOB, CCP), wire.read(BOB, 0x0D00)) == (0, 0)
    assert wire.write(BOB, CCP, 1) == GvcpStatus.OK


def test_control_is_lost_when_the_heartbeat_stops_but_any_packet_is_a_heartbeat(wire: Wire) -> None:
    wire.write(ALICE, CCP, 2)
    wire.now_s = 2.9
    wire.read(ALICE, CCP)
    wire.now_s = 5.8
    wire.read(BOB, CCP)  # somebody else's
    wire.channel.check_heartbeat(wire.now_s)
    assert wire.device.events == []
    wire.channel.check_heartbeat(6.0)
    assert wire.device.events == ["control ended"]
    assert wire.read(ALICE, CCP) == 0
    assert wire.write(ALICE, START, 1) == GvcpStatus.ACCESS_DENIED


def test_a_repeated_command_is_answered_again_but_executed_once(wire: Wire) -> None:
    wire.write(ALICE, CCP, 2)
    command = GvcpRequest(GvcpCommand.WRITEREG, 77, pack_words([START, 1])).encode()
    first = wire.channel.feed(command, ALICE, 0.0)
    assert wire.channel.feed(command, ALICE, 0.5) == first
    assert wire.device.events == ["AcquisitionStart"]
    again = GvcpRequest(GvcpCommand.WRITEREG, 78, pack_words([START, 1])).encode()
    wire.channel.feed(again, ALICE, 0.6)
    assert wire.device.events == ["AcquisitionStart"] * 2


def test_the_same_bytes_from_another_peer_are_another_command(wire: Wire) -> None:
    claim = GvcpRequest(GvcpCommand.WRITEREG, 5, pack_words([CCP, 2])).encode()
    assert decode_ack(wire.channel.feed(claim, ALICE, 0.0)).status == GvcpStatus.OK
    assert decode_ack(wire.channel.feed(claim, BOB, 0.0)).status == GvcpStatus.ACCESS_DENIED


def test_one_command_reads_or_writes_several_registers(wire: Wire) -> None:
    wire.write(ALICE, CCP, 2)
    ack = wire.ask(ALICE, GvcpCommand.WRITEREG, pack_words([PACKET_SIZE, 576, 0x0D08, 7]))
    assert ack.payload == gvcp.pack_written(2)
    ack = wire.ask(BOB, GvcpCommand.READREG, pack_words([PACKET_SIZE, 0x0D08]))
    assert gvcp.unpack_words(ack.payload) == (576, 7)


def test_memory_is_written_and_read_in_blocks(wire: Wire) -> None:
    wire.write(ALICE, CCP, 2)
    ack = wire.ask(ALICE, GvcpCommand.WRITEMEM, gvcp.pack_write_memory(0x00E8, b"left".ljust(16, b"\0")))
    assert ack.payload == gvcp.pack_written(16)
    ack = wire.ask(BOB, GvcpCommand.READMEM, pack_read_memory(0x00E8, 8))
    assert ack.payload == gvcp.pack_write_memory(0x00E8, b"left\0\0\0\0")


@pytest.mark.parametrize(
    ("command", "payload", "status"),
    [
        (0x0004, b"", GvcpStatus.NOT_IMPLEMENTED),
        (GvcpCommand.READREG, pack_words([0x0A02]), GvcpStatus.BAD_ALIGNMENT),
        (GvcpCommand.READREG, pack_words([0x90000]), GvcpStatus.BAD_ADDRESS),
        (GvcpCommand.READREG, b"\0\0", GvcpStatus.BAD_PARAMETER),
        (GvcpCommand.WRITEREG, pack_words([PACKET_SIZE]), GvcpStatus.BAD_PARAMETER),
        (GvcpCommand.WRITEREG, pack_words([PACKET_SIZE, 219]), GvcpStatus.BAD_PARAMETER),
        (GvcpCommand.READMEM, pack_read_memory(TEMPERATURE, 8), GvcpStatus.ACCESS_DENIED),
    ],
)
def test_a_command_that_cannot_be_done_is_refused_by_its_status(
    wire: Wire, command: int, payload: bytes, status: GvcpStatus
) -> None:
    wire.device.temperature_readable = False
    wire.write(ALICE, CCP, 2)
    ack = wire.ask(ALICE, command, payload)
    assert (ack.status, ack.command, ack.payload) == (status, command, b"")


def test_a_packet_resend_is_passed_on_and_never_acknowledged(wire: Wire) -> None:
    assert wire.channel.feed(Resend(7, 3, 9).request(1).encode(), ALICE, 0.0) == b""
    assert wire.channel.feed(GvcpRequest(GvcpCommand.PACKETRESEND, 2, b"short").encode(), ALICE, 0.0) == b""
    assert wire.device.events == [Resend(7, 3, 9)]


def test_a_command_without_the_acknowledge_flag_is_executed_in_silence(wire: Wire) -> None:
    claim = GvcpRequest(GvcpCommand.WRITEREG, 5, pack_words([CCP, 2]), flags=0)
    assert wire.channel.feed(claim.encode(), ALICE, 0.0) == b""
    assert wire.read(BOB, CCP) == 2


def test_noise_is_not_answered(wire: Wire) -> None:
    assert wire.channel.feed(b"GET / HTTP/1.1\r\n", BOB, 0.0) == b""


def test_nothing_is_remembered_after_a_loss_of_power(wire: Wire) -> None:
    wire.write(ALICE, CCP, 2)
    wire.channel.forget()
    assert wire.write(ALICE, PACKET_SIZE, 8000) == GvcpStatus.ACCESS_DENIED
    assert wire.device.events == []
