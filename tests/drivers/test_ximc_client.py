"""The XIMC host side against a scripted controller that numbers its answers, so that a stale one gives itself away."""

import random
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from thermostand.drivers.framing.ximc import encode
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.drivers.wires.link import ByteLink, SerialSettings, open_link
from thermostand.drivers.wires.ximc_client import XimcClient
from thermostand.foundation.errors import DeviceError, GarbledReply, Refused, Unreachable

LINE = SerialSettings(baud=115200, stopbits=2)
POSITION = struct.Struct("<ihq6x")
# As libximc 3.1.1 sends it: to step 400 less 100 microsteps, the reserved bytes filled with 0xCC.
MOVE_PAYLOAD = bytes.fromhex("900100009cffcccccccccccc")
MOVE_FRAME = b"move" + MOVE_PAYLOAD + b"\x0e\xaf"

Fault = Callable[[bytes], bytes]  # true reply -> what is sent


class Controller:
    """Answers `gpos` with the number of the request, every other request with its letters, zeros with zeros.

    faults: for the coming requests, in order. `held` is what comes out before the next answer or echo of zeros.
    `echoes_marks`: the zeros in front of a request come back, too.
    """

    def __init__(self) -> None:
        self.echoes_marks = True
        self.requests: list[bytes] = []
        self.faults: deque[Fault] = deque()
        self.echoes: deque[Fault] = deque()  # for the coming bursts of zeros
        self.held = b""

    def feed(self, data: bytes) -> bytes:
        if not data.strip(b"\0"):
            held = self._released()
            return held + (self.echoes.popleft()(data) if self.echoes else data)
        request = data.lstrip(b"\0")
        self.requests.append(request)
        letters = request[:4].decode()
        payload = POSITION.pack(len(self.requests), 0, 0) if letters == "gpos" else b""
        held = self._released() + (data[: -len(request)] if self.echoes_marks else b"")
        reply = encode(letters, payload)
        return held + (self.faults.popleft()(reply) if self.faults else reply)

    def late(self, reply: bytes) -> bytes:
        """A fault: the answer leaves after the time-out, before the next one."""
        self.held = reply
        return b""

    def _released(self) -> bytes:
        held, self.held = self.held, b""
        return held


def wrong_crc(reply: bytes) -> bytes:
    return reply[:-1] + bytes([reply[-1] ^ 0x10])


def wrong_letter(reply: bytes) -> bytes:
    return reply[:1] + bytes([reply[1] ^ 0x01]) + reply[2:]


def garbage_first(reply: bytes) -> bytes:
    return b"\x00\x2b\x0e\xff\x17\x03\x41" + reply


def half(reply: bytes) -> bytes:
    return reply[: len(reply) // 2]


def silence(reply: bytes) -> bytes:
    return b""


def twice(reply: bytes) -> bytes:
    return reply + reply


def says(answer: bytes) -> Fault:
    return lambda reply: answer


@pytest.fixture
def controller() -> Controller:
    return Controller()


@pytest.fixture
def faults() -> LinkFaults:
    return LinkFaults(seed=7)


@pytest.fixture(params=["serial", "tcp"])
def connect(
    request: pytest.FixtureRequest, controller: Controller, faults: LinkFaults, tmp_path: Path
) -> Iterator[Callable[[], ByteLink]]:
    if request.param == "serial":
        wire: PtyWire | TcpWire = PtyWire(tmp_path / "stage", controller, faults)
        address = f"serial:{tmp_path / 'stage'}"
    else:
        wire = TcpWire("127.0.0.1", 0, lambda: controller, faults)
        address = f"tcp:127.0.0.1:{wire.port}"
    yield lambda: open_link("linear", address, LINE)
    wire.close()


@pytest.fixture
def client(connect: Callable[[], ByteLink]) -> Iterator[XimcClient]:
    with closing(XimcClient("linear", connect)) as client:
        yield client


@pytest.fixture
def hurried(connect: Callable[[], ByteLink]) -> Iterator[XimcClient]:
    """For tests that wait for the time-out often. On a busy machine it may run out by itself: that costs a repeat,
    so these tests compare answers with the number of requests, not with a constant."""
    with closing(XimcClient("linear", connect, timeout_s=0.05)) as client:
        yield client


def position(client: XimcClient) -> int:
    full, _, _ = POSITION.unpack(client.query("gpos", POSITION.size))
    return full


def test_a_query_gives_the_payload_and_a_command_its_acknowledgement(
    client: XimcClient, controller: Controller
) -> None:
    assert position(client) == 1
    client.command("move", MOVE_PAYLOAD)
    client.command("sstp")
    assert position(client) == 4
    assert controller.requests == [b"gpos", MOVE_FRAME, b"sstp", b"gpos"]
    assert client.errors == 0


def test_a_reply_in_single_bytes_is_as_good(client: XimcClient, controller: Controller, faults: LinkFaults) -> None:
    faults.byte_by_byte = True
    assert [position(client) for _ in range(20)] == list(range(1, 21))
    assert client.errors == 0


DAMAGES = [wrong_crc, wrong_letter, garbage_first, half, silence, twice, says(b"errd")]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_query_with_a_damaged_answer_is_asked_once_more(
    hurried: XimcClient, controller: Controller, damage: Fault
) -> None:
    controller.faults.append(damage)
    for _ in range(2):
        assert position(hurried) == len(controller.requests)
    assert hurried.errors >= 1


@pytest.mark.parametrize("damage", [wrong_letter, garbage_first, half, silence, twice, says(b"errd")])
def test_a_command_with_a_damaged_acknowledgement_is_reported_and_never_repeated(
    hurried: XimcClient, controller: Controller, damage: Fault
) -> None:
    controller.faults.append(damage)
    with pytest.raises((GarbledReply, Unreachable), match=r"^linear: .*move"):
        hurried.command("move", MOVE_PAYLOAD)
    assert len(controller.requests) == 1
    assert position(hurried) == len(controller.requests)


def test_after_two_repeats_a_query_is_given_up(client: XimcClient, controller: Controller) -> None:
    controller.faults.extend([wrong_crc] * 3)
    with pytest.raises(GarbledReply, match=r"'gpos' \(CRC\)"):
        position(client)
    assert len(controller.requests) == 3
    assert position(client) == 4


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [(b"errc", "does not know gpos"), (b"errv", "out of range and the controller changed it")],
)
def test_an_error_of_configuration_is_reported_and_not_repeated(
    client: XimcClient, controller: Controller, answer: bytes, sentence: str
) -> None:
    controller.faults.append(says(answer))
    with pytest.raises(Refused, match=sentence):
        position(client)
    assert len(controller.requests) == 1
    assert position(client) == 2


def test_the_payload_of_an_unknown_command_is_not_taken_for_answers_to_come(
    client: XimcClient, controller: Controller
) -> None:
    """A controller that does not know the letters reads on in the payload, four bytes at a time."""
    controller.faults.append(says(b"errc" * 4))
    with pytest.raises(Refused, match="does not know move"):
        client.command("move", MOVE_PAYLOAD)
    assert position(client) == 2


def test_a_late_answer_is_never_credited_to_the_next_request(hurried: XimcClient, controller: Controller) -> None:
    for _ in range(4):
        controller.faults.append(controller.late)
        assert position(hurried) == len(controller.requests)
    assert len(controller.requests) >= 8


def test_a_late_acknowledgement_is_never_credited_to_the_next_command(
    client: XimcClient, controller: Controller
) -> None:
    controller.faults.extend([controller.late, says(b"errd")])
    with pytest.raises(Unreachable, match=r"move within 0\.25 s"):
        client.command("move", MOVE_PAYLOAD)
    with pytest.raises(GarbledReply, match="received move damaged"):
        client.command("move", MOVE_PAYLOAD)


def test_a_break_on_the_line_is_not_taken_for_the_echo_that_ends_a_resynchronisation(
    hurried: XimcClient, controller: Controller
) -> None:
    """One zero comes, the controller is still busy with the first request; its answer and the echo come after."""

    def break_first(zeros: bytes) -> bytes:
        controller.held = late + zeros
        return b"\0"

    late = encode("gpos", POSITION.pack(1, 0, 0))
    controller.faults.append(silence)
    controller.echoes.append(break_first)
    for _ in range(2):
        assert position(hurried) == len(controller.requests)


def test_zeros_that_end_a_late_answer_are_not_taken_for_the_echo(hurried: XimcClient, controller: Controller) -> None:
    """The late answer arrives in two parts, the first of which ends in zeros."""
    late = encode("gpos", POSITION.pack(1, 0, 0))

    def first_part(zeros: bytes) -> bytes:
        controller.held = late[20:] + zeros
        return late[:20]

    controller.faults.append(silence)
    controller.echoes.append(first_part)
    assert position(hurried) == len(controller.requests)


def test_a_second_copy_of_an_answer_is_not_taken_for_the_next_one_whenever_it_comes(
    client: XimcClient, controller: Controller
) -> None:
    """Here behind the next request, whose answer has the same letters."""
    copy = encode("gpos", POSITION.pack(1, 0, 0))
    assert position(client) == 1
    controller.held = copy
    assert position(client) == len(controller.requests) == 3
    controller.held = b"move"
    with pytest.raises(GarbledReply, match="or an earlier answer"):
        client.command("move", MOVE_PAYLOAD)
    assert position(client) == len(controller.requests)


def test_a_controller_that_echoes_no_single_zeros_is_spoken_to_without_them(
    client: XimcClient, controller: Controller
) -> None:
    controller.echoes_marks = False
    assert [position(client) for _ in range(3)] == [1, 2, 3]
    assert client.errors == 0


def test_bytes_that_nobody_asked_for_are_dropped_before_the_next_request(
    hurried: XimcClient, controller: Controller, faults: LinkFaults
) -> None:
    faults.byte_by_byte = True  # so that the second copy comes after the first was used
    for number in range(1, 6):
        controller.faults.append(twice)
        assert position(hurried) >= number
        assert position(hurried) == len(controller.requests)
    assert hurried.errors >= 1


def test_silence_is_unreachable_in_bounded_time_and_nothing_is_asked_twice_over_a_dead_link(
    hurried: XimcClient, controller: Controller, faults: LinkFaults
) -> None:
    faults.silent = True
    begun_s = time.monotonic()
    with pytest.raises(Unreachable, match=r"^linear: "):
        position(hurried)
    assert time.monotonic() - begun_s < 10.0  # five time-outs of 0.05 s, on a busy machine
    assert len(controller.requests) == 1
    assert not hurried.connected
    faults.silent = False
    assert position(hurried) == len(controller.requests)


def test_an_echo_lost_three_times_still_resynchronises(client: XimcClient, controller: Controller) -> None:
    """Of five bursts: two that are left are few for a busy machine and a short time-out."""
    controller.faults.append(wrong_crc)
    controller.echoes.extend([silence] * 3)
    assert position(client) == len(controller.requests)


@pytest.mark.parametrize("noise", [b"\0" * 64, b"\xff" * 64, b"gpos" * 16], ids=["zeros", "ones", "letters"])
def test_a_peer_that_never_stops_talking_does_not_hold_the_caller(noise: bytes) -> None:
    def babble(server: socket.socket) -> None:
        connection, _ = server.accept()
        with connection:
            try:
                while True:
                    connection.sendall(noise)
            except OSError:
                return

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=babble, args=(server,))
        thread.start()
        address = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        with closing(XimcClient("linear", lambda: open_link("linear", address, LINE), 0.05)) as client:
            begun_s = time.monotonic()
            with pytest.raises(DeviceError, match=r"^linear: "):
                position(client)
            assert time.monotonic() - begun_s < 10.0
        thread.join()


def test_a_port_unplugged_and_plugged_in_again_is_opened_again(controller: Controller, tmp_path: Path) -> None:
    wire = PtyWire(tmp_path / "stage", controller, LinkFaults())
    with closing(XimcClient("linear", lambda: open_link("linear", f"serial:{tmp_path / 'stage'}", LINE))) as client:
        assert position(client) == 1
        wire.close()
        with pytest.raises(Unreachable, match="stage is gone"):
            position(client)
        with pytest.raises(Unreachable, match="No such file"):
            position(client)
        assert not client.connected
        wire = PtyWire(tmp_path / "stage", controller, LinkFaults())
        assert position(client) == 2
        assert client.connected
    wire.close()


def test_a_tcp_connection_lost_is_made_again(controller: Controller) -> None:
    wire = TcpWire("127.0.0.1", 0, lambda: controller, LinkFaults())
    port = wire.port
    with closing(XimcClient("linear", lambda: open_link("linear", f"tcp:127.0.0.1:{port}", LINE))) as client:
        assert position(client) == 1
        wire.close()
        with pytest.raises(Unreachable, match=rf"127\.0\.0\.1:{port}"):
            position(client)
        with pytest.raises(Unreachable, match="Connection refused"):
            position(client)
        wire = TcpWire("127.0.0.1", port, lambda: controller, LinkFaults())
        assert position(client) == 2
    wire.close()


@pytest.mark.parametrize("connect", ["serial"], indirect=True)
def test_five_hundred_reads_with_a_fault_in_every_fifth_reply_give_no_wrong_value(
    hurried: XimcClient, controller: Controller, faults: LinkFaults
) -> None:
    faults.flip, faults.junk, faults.cut, faults.drop = 0.11, 0.08, 0.005, 0.005
    right = lost = 0
    for _ in range(500):
        try:
            assert position(hurried) == len(controller.requests)
            right += 1
        except DeviceError:
            lost += 1
    assert right + lost == 500
    assert lost <= 20
    assert sum(faults.injected.values()) > 100


@pytest.mark.parametrize("connect", ["serial"], indirect=True)
def test_a_soak_of_late_damaged_and_missing_answers_gives_no_wrong_value(
    hurried: XimcClient, controller: Controller
) -> None:
    seeded = random.Random(2018)
    for _ in range(30):
        if seeded.random() < 0.4:
            controller.faults.append(seeded.choice([controller.late, *DAMAGES]))
        if seeded.random() < 0.2:
            controller.echoes.append(seeded.choice([silence, half, lambda zeros: b"\0"]))
        try:
            assert position(hurried) == len(controller.requests)
        except DeviceError:
            continue
