"""The fake camera on its sockets, its plant, and a client with nothing but sockets and codecs."""

import socket
import struct
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tests.addresses import allocate_camera_address
from tests.sim.gvcp_client import Packet, decode_ack, decode_leader, decode_packet, pack_read_memory
from tests.still_plant import StillPlant
from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.genicam import make_features
from thermostand.drivers.sim.gige.gvcp import Ack, GvcpCommand, GvcpRequest, GvcpStatus, Resend
from thermostand.drivers.sim.gige.gvsp import PacketKind
from thermostand.foundation.clock import to_ns

WIDTH, HEIGHT = 320, 240
START_NS = to_ns(1_700_000_000.0)
FEATURES = {feature.name: feature for feature in make_features(WIDTH, HEIGHT, "SN1")}
WAIT_s = 5.0
SILENCE_s = 0.1


@cache
def address() -> str:
    """Of the camera, in this process."""
    return allocate_camera_address()


def still_plant() -> StillPlant:
    return StillPlant(START_NS, sensor=41.37, body=33.1)


def render(time_ns: int, exposure_s: float, gain_dB: float, rows: int = HEIGHT) -> NDArray[np.uint8]:
    """Another pattern for every instant, exposure and gain."""
    seed = (time_ns, round(exposure_s * 1e6), round(gain_dB * 10))
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)[:rows]


class Client:
    """The other end of both protocols, with nothing but sockets and codecs."""

    def __init__(self) -> None:
        self.control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.control.bind(("127.0.0.1", 0))
        self.stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self.stream.bind(("127.0.0.1", 0))
        self.req_id = 0

    def ask(self, command: int, payload: bytes) -> Ack:
        """The acknowledge of one command; TimeoutError when there is none."""
        self.req_id += 1
        self.control.settimeout(WAIT_s)
        self.control.sendto(GvcpRequest(command, self.req_id, payload).encode(), (address(), gvcp.PORT))
        return decode_ack(self.control.recv(1024))

    def is_ignored(self) -> bool:
        self.control.settimeout(SILENCE_s)
        self.control.sendto(GvcpRequest(GvcpCommand.DISCOVERY, 0xFFFF).encode(), (address(), gvcp.PORT))
        try:
            self.control.recv(1024)
        except TimeoutError:
            return True
        return False

    def set(self, name: str, value: float) -> int:
        feature = FEATURES[name]
        data = struct.pack(">d", value) if feature.kind == "float" else int(value).to_bytes(4, "big")
        return self.ask(GvcpCommand.WRITEMEM, gvcp.pack_write_memory(feature.address, data)).status

    def get(self, name: str) -> float:
        feature = FEATURES[name]
        payload = pack_read_memory(feature.address, feature.length)
        ack = self.ask(GvcpCommand.READMEM, payload)
        assert ack.status == GvcpStatus.OK
        data = ack.payload[4:]
        return struct.unpack(">d", data)[0] if feature.kind == "float" else int.from_bytes(data, "big")

    def connect(self, packet_size: int = 1500) -> None:
        """Take control and open the stream."""
        assert self.set("GevCCP", 2) == GvcpStatus.OK
        assert self.set("GevSCDA", 0x7F000001) == GvcpStatus.OK
        assert self.set("GevSCPHostPort", self.stream.getsockname()[1]) == GvcpStatus.OK
        assert self.set("GevSCPSPacketSize", packet_size) == GvcpStatus.OK

    def arm(self, exposure_us: float = 100_000.0) -> None:
        """Wait for software triggers."""
        self.set("ExposureTime", exposure_us)
        self.set("TriggerMode", 1)
        self.set("AcquisitionStart", 1)

    def resend(self, block_id: int, first: int, last: int, extended: bool = False) -> None:
        request = Resend(block_id, first, last, extended).request(1)
        self.control.sendto(request.encode(), (address(), gvcp.PORT))

    def packet(self, wait_s: float = WAIT_s) -> Packet:
        self.stream.settimeout(wait_s)
        return decode_packet(self.stream.recv(65536))

    def packets(self) -> list[Packet]:
        """All packets up to a trailer."""
        packets = [self.packet()]
        while packets[-1].kind != PacketKind.TRAILER:
            packets.append(self.packet())
        return packets

    def stream_is_silent(self) -> bool:
        try:
            self.packet(SILENCE_s)
        except TimeoutError:
            return True
        return False

    def close(self) -> None:
        self.control.close()
        self.stream.close()


def image_of(packets: list[Packet]) -> NDArray[np.uint8]:
    leader = decode_leader(packets[0].data)
    pixels = b"".join(packet.data for packet in packets if packet.kind == PacketKind.PAYLOAD)
    return np.frombuffer(pixels, np.uint8).reshape(leader.height, leader.width)


def expected(start_s: float, exposure_s: float = 0.1, gain_dB: float = 0.0) -> NDArray[np.uint8]:
    return render(START_NS + to_ns(start_s + exposure_s / 2), exposure_s, gain_dB)
