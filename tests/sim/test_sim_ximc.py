"""The fake controllers: what they answer byte for byte, and how their stages move on a clock in hand."""

import struct
import threading
from collections.abc import Callable
from typing import Literal, NamedTuple, cast

import pytest

from drivers.framing.ximc import Damage, decode, encode
from drivers.sim.motion.ximc import FakeAxis
from drivers.sim.motion.ximc_table import LINEAR_8MT160_300, ROTARY_8MR151
from drivers.sim.physics.plant import Plant
from foundation.clock import FollowedClock, seconds_ns

T0 = 1_700_000_000_000_000_000

# Total sizes of the settings, from the protocol description.
SETTING_SIZES = {
    "mov": 30, "eng": 34, "eds": 26, "hom": 33, "pwr": 20, "sec": 28, "ctp": 18, "ent": 14, "fbs": 18, "nmf": 30,
    "nme": 30, "sti": 70, "sts": 70, "pid": 48, "sni": 28, "sno": 16, "eio": 18, "brk": 25, "ctl": 93, "joy": 22,
    "urt": 16, "net": 38, "pwd": 36, "cal": 118, "nvm": 36, "emf": 48, "eas": 54, "est": 46, "mti": 70, "mts": 112,
    "eni": 70, "ens": 54, "hsi": 70, "hss": 50, "gri": 70, "grs": 58, "acc": 114,
}  # fmt: skip
QUERY_SIZES = {
    "gets": 54, "gpos": 26, "getm": 216, "geti": 36, "gser": 10, "gfwv": 10, "gblv": 10, "getc": 38, "guid": 40,
    "rdan": 76,
}  # fmt: skip
SERVICE_SIZES = {
    "sser": 50, "dbgr": 4, "dbgw": 142, "updf": 4, "clfr": 4, "gofw": 4, "hasf": 4, "wkey": 46, "conn": 14, "disc": 14,
    "wdat": 142, "rest": 4, "irnd": 4,
}  # fmt: skip

# A conversation of libximc 3.1.1 with the linear stage, requests as sent; it fills reserved bytes with 0xCC.
LIBXIMC_REQUESTS = [
    bytes.fromhex(text)
    for text in (
        "67657469", "67736572", "67667776", "67657473", "676d6f76",
        "736d6f768813000000204e204ee80300000000cccccccccccccccccc761b", "67686f6d",
        "73686f6db80b000000f401000000f401000000007201cccccccccccccccccc9713", "67656e67", "676e6d65", "686f6d65",
        "67657473", "7a65726f", "6d6f7665900100009cffcccccccccccc0eaf", "6d6f7672640000003200cccccccccccc3c66",
        "73746f70", "73737470", "67706f73", "736d6f7688130000000000204ee80300000000cccccccccccccccccc8ae3",
    )
]  # fmt: skip

RUNNING, FAILED = 0x80, 0x40
MOVE, MOVR, LEFT, RIGT, STOP, HOME, LOFT, SSTP = range(1, 9)
POWER_OFF, POWER_NORMAL, POWER_REDUCED = 1, 3, 4
ERRC, ERRD, ERRV, EEPROM, HOMED, ALARM, CTP_ERROR, SWAPPED = 0x1, 0x2, 0x4, 0x10, 0x20, 0x40, 0x80, 0x8000
RIGHT_EDGE, LEFT_EDGE = 1, 2


class Laboratory:
    """The part of the plant a stage uses."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.linear_mm_at: Callable[[int], float] = lambda _: -1.0
        self.rotary_deg_at: Callable[[int], float] = lambda _: -1.0

    def advance(self, now_ns: int) -> None:
        pass


class Status(NamedTuple):
    move_state: int
    command: int
    power: int
    encoder_state: int
    windings: int
    full: int
    micro: int
    encoder: int
    speed: int
    micro_speed: int
    supply_mA: int
    supply_10mV: int
    usb_mA: int
    usb_10mV: int
    temperature_0_1degC: int
    flags: int
    edges: int
    queue_free: int

    @property
    def steps(self) -> float:
        return self.full + self.micro / 256


class Bench:
    """A stage, its controller on one connection, and both clocks in hand."""

    def __init__(self, attach: Literal["linear", "rotary"], start_steps: float = 2_000.0) -> None:
        self.plant = Laboratory()
        self.clock = FollowedClock(T0)
        profile = LINEAR_8MT160_300 if attach == "linear" else ROTARY_8MR151
        self.axis = FakeAxis(cast(Plant, self.plant), self.clock, profile, 0x1234, attach, start_steps)
        self.real_s = 0.0
        self.engine = self.axis.engine(lambda: self.real_s)

    def wait(self, duration_s: float) -> None:
        self.clock.follow(self.clock.now_ns() + seconds_ns(duration_s))

    def ask(self, letters: str, payload: bytes = b"", size: int = 4) -> bytes:
        frame, rest = decode(self.engine.feed(encode(letters, payload)), {letters: max(0, size - 6)})
        assert frame is not None
        assert (frame.damage, rest) == (Damage.NONE, b"")
        return frame.payload

    def status(self) -> Status:
        return Status(*struct.unpack("<BBBBBihqih5hIIB4x", self.ask("gets", size=54)))

    def move(self, full: int, micro: int = 0, letters: str = "move") -> None:
        self.ask(letters, struct.pack("<ih6x", full, micro))

    def change(self, name: str, layout: str, **fields: int) -> None:
        """Read a setting, replace fields by index (f0=..., f3=...), write it back."""
        values = list(struct.unpack(layout, self.ask("g" + name, size=SETTING_SIZES[name])))
        for index, value in fields.items():
            values[int(index[1:])] = value
        self.ask("s" + name, struct.pack(layout, *values))

    def home(self) -> None:
        self.ask("home")
        self.wait(60)
        assert self.status().command == HOME

    def settle(self) -> Status:
        """Wait for the end of the motion; a minute is longer than any here."""
        self.wait(60)
        return self.status()


@pytest.fixture
def linear() -> Bench:
    return Bench("linear")


@pytest.fixture
def rotary() -> Bench:
    return Bench("rotary")


# The wire


def test_the_controller_says_who_it_is(linear: Bench) -> None:
    assert linear.ask("gser", size=10) == struct.pack("<I", 0x1234)
    assert linear.ask("geti", size=36) == struct.pack("<4s2s8sBBH12x", b"XIMC", b"SM", b"XISM-USB", 2, 3, 8)
    assert linear.ask("gfwv", size=10) == struct.pack("<BBH", 4, 7, 6)


@pytest.mark.parametrize(("letters", "size"), QUERY_SIZES.items())
def test_every_query_is_answered_in_its_size(linear: Bench, letters: str, size: int) -> None:
    assert len(linear.ask(letters, size=size)) == size - 6


@pytest.mark.parametrize(("name", "size"), SETTING_SIZES.items())
def test_every_setting_is_written_as_it_is_read(linear: Bench, name: str, size: int) -> None:
    payload = linear.ask("g" + name, size=size)
    assert linear.engine.feed(encode("s" + name, payload)) == encode("s" + name)
    assert linear.ask("g" + name, size=size) == payload


@pytest.mark.parametrize("letters", ["stms", "sars", "rers", "eesv", "eerd", "asia", "save", "read"])
def test_commands_without_effect_are_acknowledged(linear: Bench, letters: str) -> None:
    linear.ask(letters, bytes(16) if letters == "asia" else b"")
    assert linear.status().command == 0


@pytest.mark.parametrize("pieces", [(1,), (3, 7, 1, 2), (5,), (64, 1)])
def test_requests_of_libximc_are_understood_in_ugly_chunks(linear: Bench, pieces: tuple[int, ...]) -> None:
    whole = Bench("linear")
    expected = b"".join(whole.engine.feed(request) for request in LIBXIMC_REQUESTS)
    assert expected[-4:] == b"errv"
    wire, reply, turn = b"".join(LIBXIMC_REQUESTS), b"", 0
    while wire:
        size = pieces[turn % len(pieces)]
        reply += linear.engine.feed(wire[:size])
        wire, turn = wire[size:], turn + 1
    assert reply == expected
    assert b"errc" not in reply
    assert b"errd" not in reply


def test_reserved_bytes_are_ignored_and_read_as_zero(linear: Bench) -> None:
    linear.engine.feed(LIBXIMC_REQUESTS[5])
    assert linear.ask("gmov", size=30) == struct.pack("<IBHHIBB9x", 5_000, 0, 20_000, 20_000, 1_000, 0, 0)


def test_zeros_between_frames_come_back_one_for_one(linear: Bench) -> None:
    assert linear.engine.feed(bytes(64)) == bytes(64)
    assert linear.engine.feed(b"\0\0stms\0") == b"\0\0stms\0"


def test_zeros_inside_a_frame_complete_it_and_then_come_back(linear: Bench) -> None:
    request = encode("move", struct.pack("<ih6x", 400, 0))
    assert linear.engine.feed(request[:10]) == b""
    assert linear.engine.feed(bytes(64)) == b"errd" + bytes(64 - 8)
    assert linear.status().command == 0


def test_a_partial_frame_is_forgotten_after_400_ms(linear: Bench) -> None:
    linear.engine.feed(b"move\x01\x02")
    linear.real_s = 0.39
    assert linear.engine.feed(b"\0") == b""
    linear.real_s = 0.80
    assert linear.engine.feed(b"stms") == b"stms"


def test_a_wrong_crc_is_answered_and_latched_until_stop(linear: Bench) -> None:
    request = bytearray(encode("move", struct.pack("<ih6x", 400, 0)))
    request[-1] ^= 1
    assert linear.engine.feed(bytes(request)) == b"errd"
    assert (linear.status().flags & 7, linear.status().command) == (ERRD, 0)
    linear.ask("stop")
    assert linear.status().flags & 7 == 0


def test_an_unknown_command_is_answered_and_its_payload_is_taken_for_letters(linear: Bench) -> None:
    assert linear.engine.feed(b"xyzwABCDstms") == b"errcerrcstms"
    assert linear.status().flags & 7 == ERRC


@pytest.mark.parametrize(("letters", "size"), SERVICE_SIZES.items())
def test_service_commands_are_refused_whole(linear: Bench, letters: str, size: int) -> None:
    request = encode(letters, b"\x55" * max(0, size - 6))
    assert len(request) == size
    assert linear.engine.feed(request + b"stms") == b"errcstms"


def test_connections_have_partial_frames_of_their_own(linear: Bench) -> None:
    other = linear.axis.engine(lambda: 0.0)
    assert linear.engine.feed(b"st") == b""
    assert other.feed(b"stms") == b"stms"
    assert linear.engine.feed(b"ms") == b"stms"


@pytest.mark.parametrize(
    ("name", "layout", "index", "wrong", "corrected"),
    [
        ("mov", "<IBHHIBB9x", 0, 100_001, 100_000),
        ("mov", "<IBHHIBB9x", 2, 0, 1),
        ("eng", "<HHIBHhBH12x", 1, 14, 15),
        ("eng", "<HHIBHhBH12x", 6, 10, 9),
        ("pwr", "<BHHHB6x", 0, 101, 100),
    ],
)
def test_a_value_out_of_range_is_corrected_and_reported(
    linear: Bench, name: str, layout: str, index: int, wrong: int, corrected: int
) -> None:
    values = list(struct.unpack(layout, linear.ask("g" + name, size=SETTING_SIZES[name])))
    values[index] = wrong
    assert linear.engine.feed(encode("s" + name, struct.pack(layout, *values))) == b"errv"
    assert struct.unpack(layout, linear.ask("g" + name, size=SETTING_SIZES[name]))[index] == corrected
    assert linear.status().flags & 7 == ERRV


def test_settings_survive_a_power_cycle_only_when_saved(linear: Bench) -> None:
    linear.change("mov", "<IBHHIBB9x", f0=700)
    linear.ask("save")
    linear.change("mov", "<IBHHIBB9x", f0=800)
    linear.axis.power_cycle()
    assert linear.ask("gmov", size=30)[:4] == struct.pack("<I", 700)
    linear.change("mov", "<IBHHIBB9x", f0=800)
    linear.ask("read")
    assert linear.ask("gmov", size=30)[:4] == struct.pack("<I", 700)


# Motion


def test_after_power_on_it_stands_at_count_zero_unhomed_without_current(linear: Bench) -> None:
    status = linear.status()
    assert (status.steps, status.command, status.power, status.flags) == (0, 0, POWER_OFF, EEPROM)
    assert linear.plant.linear_mm_at(T0) == 5.0


def test_a_move_is_a_trapezoid_in_simulated_time(linear: Bench) -> None:
    linear.move(1_000)
    expected = {0.25: (62.5, 500, 1), 0.75: (500, 1_000, 3), 1.25: (968.75, 500, 1)}
    passed_s = 0.0
    for instant_s, (steps, speed, move_state) in expected.items():
        linear.wait(instant_s - passed_s)
        passed_s = instant_s
        status = linear.status()
        assert status.command == MOVE | RUNNING
        assert (status.steps, status.speed, status.move_state) == (steps, speed, move_state)
    linear.wait(1.375 - passed_s)
    status = linear.status()
    assert (status.command, status.steps, status.speed, status.move_state) == (MOVE, 1_000, 0, 0)


def test_the_motion_does_not_depend_on_how_often_it_is_asked_for() -> None:
    often, once = Bench("linear"), Bench("linear")
    for bench in (often, once):
        bench.ask("home")
    for _ in range(500):
        often.wait(0.0137)
        often.status()
    once.wait(500 * 0.0137)
    assert often.status() == once.status()
    assert often.clock.now_ns() == once.clock.now_ns()


@pytest.mark.parametrize(("full", "micro"), [(0, 100), (0, -100), (12, 255), (-12, -1), (3, -128)])
def test_microsteps_are_kept_whatever_their_sign(linear: Bench, full: int, micro: int) -> None:
    linear.move(full, micro)
    assert linear.settle().steps == full + micro / 256


def test_too_many_microsteps_are_corrected(linear: Bench) -> None:
    assert linear.engine.feed(encode("move", struct.pack("<ih6x", 10, 300))) == b"errv"
    assert linear.settle().steps == 10 + 255 / 256


def test_movr_counts_from_the_target_not_from_the_position(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.5)
    linear.move(100, 128, "movr")
    status = linear.settle()
    assert (status.steps, status.command) == (1_100.5, MOVR)
    linear.move(-100, -128, "movr")
    assert linear.settle().steps == 1_000


def test_movr_after_a_stop_counts_from_where_it_stopped(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.5)
    linear.ask("sstp")
    stopped = linear.settle()
    assert (stopped.command, stopped.steps) == (SSTP, 375)
    linear.move(100, letters="movr")
    assert linear.settle().steps == 475


def test_zero_in_motion_keeps_the_physical_destination(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.65)
    assert linear.status().steps == 400
    linear.ask("zero")
    assert linear.status().steps == 0
    status = linear.settle()
    assert (status.steps, status.command) == (600, MOVE)
    linear.move(10, letters="movr")
    assert linear.settle().steps == 610
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == pytest.approx((2_000 + 1_010) * 0.0025)


def test_zero_at_rest_makes_the_stored_target_zero(linear: Bench) -> None:
    linear.move(1_000)
    linear.settle()
    linear.ask("zero")
    linear.move(10, letters="movr")
    assert linear.settle().steps == 10


def test_spos_sets_count_and_encoder_unless_asked_to_leave_them(linear: Bench) -> None:
    linear.ask("spos", struct.pack("<ihqB5x", 100, 64, 7, 0))
    assert struct.unpack("<ihq6x", linear.ask("gpos", size=26)) == (100, 64, 7)
    linear.ask("spos", struct.pack("<ihqB5x", 1, 1, 1, 3))
    assert struct.unpack("<ihq6x", linear.ask("gpos", size=26)) == (100, 64, 7)


def test_left_and_right_run_until_something_stops_them(linear: Bench) -> None:
    linear.ask("rigt")
    linear.wait(10.25)
    assert (linear.status().command, linear.status().steps) == (RIGT | RUNNING, 10_000)
    linear.ask("left")
    linear.wait(60)
    status = linear.status()
    assert (status.command, status.steps, status.edges) == (LEFT | FAILED, -2_500, LEFT_EDGE)


def test_loft_goes_away_by_the_antiplay_and_comes_back(linear: Bench) -> None:
    linear.ask("loft")
    linear.wait(575 / 1_000 + 0.375)
    assert (linear.status().steps, linear.status().move_state & 4) == (pytest.approx(575, abs=0.01), 4)
    status = linear.settle()
    assert (status.command, status.steps) == (LOFT, pytest.approx(0, abs=1 / 256))


def test_a_speed_above_the_nominal_one_is_limited(linear: Bench) -> None:
    linear.change("mov", "<IBHHIBB9x", f0=9_000)
    linear.move(20_000)
    linear.wait(3)
    assert linear.status().speed == 3_200


def test_speed_zero_never_gets_there(linear: Bench) -> None:
    linear.change("mov", "<IBHHIBB9x", f0=0)
    linear.move(100)
    assert (linear.settle().command, linear.status().steps) == (MOVE | RUNNING, 0)


# Homing and limits


def test_homing_ends_at_mechanical_zero_and_leaves_the_count_for_zero_to_clear(linear: Bench) -> None:
    linear.ask("home")
    assert linear.status().command == HOME | RUNNING
    linear.home()
    status = linear.status()
    assert (status.steps, status.flags) == (-2_000, EEPROM | HOMED)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 0
    linear.ask("zero")
    assert linear.status().steps == 0
    assert linear.status().flags & HOMED


def test_homing_takes_as_long_as_its_speeds_say(linear: Bench) -> None:
    linear.ask("home")
    to_switch_s = 2_500 / 500 + 0.125  # accelerating at 2000/s2 costs half of 0.25 s
    linear.wait(to_switch_s)
    assert (linear.status().steps, linear.status().edges) == (pytest.approx(-2_500, abs=0.01), LEFT_EDGE)
    linear.wait(500 / 500 + 0.25 / 2 + 0.125 / 2 - 0.001)
    assert linear.status().command == HOME | RUNNING
    linear.wait(0.002)
    assert linear.status().command == HOME


def test_the_turntable_homes_at_its_only_switch_and_turns_without_end(rotary: Bench) -> None:
    rotary.home()
    assert rotary.status().steps == -2_000
    assert rotary.plant.rotary_deg_at(rotary.clock.now_ns()) == pytest.approx(0, abs=1e-9)
    rotary.ask("zero")
    rotary.move(80_000)
    status = rotary.settle()
    assert (status.command, status.steps, status.edges) == (MOVE, 80_000, 0)
    assert rotary.plant.rotary_deg_at(rotary.clock.now_ns()) == 800
    rotary.move(72_000 + 1_250)
    assert rotary.settle().edges == LEFT_EDGE


def test_homing_can_seek_a_second_switch(linear: Bench) -> None:
    first_right_second_left_by_switches = 0x1 | 0x4 | 0x30 | 0xC0
    linear.change("hom", "<IBIBihH9x", f0=3_000, f2=3_000, f4=-100, f6=first_right_second_left_by_switches)
    linear.ask("home")
    linear.wait(117_500 / 3_000 + 0.75)
    assert linear.status().steps == pytest.approx(117_500, abs=1), "at the right switch"
    linear.wait(60)
    assert linear.status().command == HOME
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == pytest.approx((-500 + 100) * 0.0025)


def test_a_move_into_the_limit_fails_and_can_be_taken_back(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.change("mov", "<IBHHIBB9x", f0=3_000)
    linear.move(125_000)
    status = linear.settle()
    assert (status.command, status.edges, status.flags & HOMED) == (MOVE | FAILED, RIGHT_EDGE, HOMED)
    assert status.steps == 119_500
    linear.move(119_600)
    assert linear.status().command == MOVE | FAILED, "no further in that direction"
    linear.move(119_000)
    status = linear.settle()
    assert (status.command, status.edges, status.steps) == (MOVE, 0, 119_000)


def test_border_values_stop_the_motor_when_they_are_in_force(linear: Bench) -> None:
    linear.change("eds", "<BBihih6x", f0=1 | 2 | 4, f2=-50, f4=300)
    linear.move(1_000)
    assert (linear.settle().command, linear.status().steps) == (MOVE | FAILED, 300)
    linear.move(-1_000)
    assert (linear.settle().command, linear.status().steps) == (MOVE | FAILED, -50)


def test_a_stuck_limit_switch_stops_the_move_where_it_is(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.axis.limit = "right"
    linear.wait(0.001)
    status = linear.status()
    assert (status.command, status.steps, status.edges) == (MOVE | FAILED, 500, RIGHT_EDGE)
    linear.move(0)
    assert (linear.settle().command, linear.status().steps) == (MOVE, 0)
    linear.axis.limit = ""
    linear.move(600)
    assert (linear.settle().steps, linear.status().edges) == (600, 0)


def test_the_wrong_limit_raises_an_alarm_that_only_stop_clears(linear: Bench) -> None:
    linear.axis.wrong_limit = True
    linear.ask("left")
    status = linear.settle()
    assert (status.command, status.edges) == (LEFT | FAILED, RIGHT_EDGE)
    assert status.flags == EEPROM | ALARM | SWAPPED
    linear.move(100)
    assert linear.status().command == LEFT | FAILED, "motion is ignored in alarm"
    linear.ask("stop")
    assert linear.status().flags == EEPROM
    linear.move(100)
    assert linear.status().command == MOVE | RUNNING


# Other faults


def test_an_alarm_stops_the_motor_until_stop_clears_it(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.axis.alarm = True
    assert linear.axis.alarm
    status = linear.settle()
    assert (status.command, status.steps, status.flags) == (MOVE | FAILED, 500, EEPROM | ALARM)
    linear.ask("home")
    assert linear.status().command == MOVE | FAILED
    linear.ask("stop")
    assert (linear.status().command, linear.status().flags) == (STOP, EEPROM)


def test_a_ctp_error_loses_the_scale(linear: Bench) -> None:
    linear.home()
    linear.axis.ctp_error = True
    assert linear.axis.ctp_error
    assert linear.status().flags == EEPROM | CTP_ERROR
    linear.axis.ctp_error = False
    assert linear.status().flags == EEPROM


def test_any_danger_bit_can_be_raised(linear: Bench) -> None:
    linear.axis.danger = 0x200 | 0x20000
    assert linear.status().flags == EEPROM | 0x20200
    linear.ask("stop")
    assert linear.status().flags == EEPROM


def test_steps_lost_at_an_obstacle_show_at_the_next_home_check(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.axis.stall_steps = 600
    linear.move(1_000)
    status = linear.settle()
    assert (status.command, status.steps, status.flags & HOMED) == (MOVE, 1_000, HOMED), "the controller saw nothing"
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 600 * 0.0025
    linear.move(900)
    assert linear.settle().steps == 900
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 500 * 0.0025
    linear.axis.stall_steps = None
    linear.home()
    assert linear.status().steps == 400, "the residual of the home check"
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 0


def test_an_obstacle_before_the_switch_keeps_the_limit_from_being_reached(linear: Bench) -> None:
    linear.axis.stall_steps = 3_000
    linear.move(150_000)
    linear.wait(200)
    assert (linear.status().command, linear.status().edges) == (MOVE, 0)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == pytest.approx(7.5)


def test_steps_can_be_lost_by_order(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.axis.lost_steps = 40
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == pytest.approx(-0.1)
    linear.home()
    assert linear.status().steps == 40


def test_an_endless_command_runs_until_a_soft_stop(linear: Bench) -> None:
    linear.axis.endless = True
    linear.move(100)
    assert linear.settle().command == MOVE | RUNNING
    linear.ask("sstp")
    assert linear.status().command == SSTP


def test_stop_is_immediate_and_loses_the_scale_only_out_of_motion(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.ask("stop")
    assert linear.status().flags & HOMED
    linear.move(1_000)
    linear.wait(0.75)
    linear.ask("stop")
    status = linear.settle()
    assert (status.command, status.steps, status.flags & HOMED) == (STOP, 500, 0)


def test_a_power_cycle_forgets_position_and_scale_but_not_the_place(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.move(400)
    linear.settle()
    linear.axis.power_cycle()
    status = linear.status()
    assert (status.steps, status.command, status.power, status.flags) == (0, 0, POWER_OFF, EEPROM)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 1.0


# Current in the windings


def test_the_linear_stage_loses_current_60_s_after_a_stop_and_relaxes_to_a_full_step(linear: Bench) -> None:
    linear.move(100, 64)
    linear.wait(0.1)
    assert linear.status().power == POWER_NORMAL
    linear.wait(2)
    rested = linear.status()
    assert (rested.power, rested.steps) == (POWER_REDUCED, 100.25)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 2_100.25 * 0.0025
    linear.wait(60)
    off = linear.status()
    assert (off.power, off.steps) == (POWER_OFF, 100.25)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 2_100 * 0.0025
    linear.move(100, 64)
    assert linear.settle().steps == 100.25


def test_the_turntable_keeps_reduced_current(rotary: Bench) -> None:
    rotary.move(100)
    rotary.wait(1_000)
    assert rotary.status().power == POWER_REDUCED


def test_the_motor_goes_off_by_command_at_rest_only(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.ask("pwof")
    assert (linear.status().power, linear.status().command) == (POWER_NORMAL, MOVE | RUNNING)
    linear.wait(5)
    linear.ask("pwof")
    assert linear.status().power == POWER_OFF
    linear.move(0)
    assert linear.status().power == POWER_NORMAL


def test_the_motor_can_fail_in_motion(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.axis.motor_off = True
    assert linear.axis.motor_off
    status = linear.settle()
    assert (status.power, status.command, status.steps) == (POWER_OFF, MOVE | FAILED, 500)


def test_the_plant_may_ask_for_a_moment_just_past_or_still_to_come(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.ask("stop")
    places_mm = [linear.plant.linear_mm_at(T0 + seconds_ns(time_s)) for time_s in (0.0, 0.25, 0.5, 0.75, 5.0)]
    assert places_mm == pytest.approx([5.0, 5.0 + 62.5 * 0.0025, 5.0 + 250 * 0.0025, 6.25, 6.25])
