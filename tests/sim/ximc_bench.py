"""A simulated stage on the bench: its controller on one connection, and both clocks in hand."""

import struct
from typing import Literal, NamedTuple

from tests.still_plant import StillPlant
from thermostand.drivers.framing.ximc import XimcDamage, decode, encode
from thermostand.drivers.sim.motion.ximc import FakeAxis
from thermostand.drivers.sim.motion.ximc_table import LINEAR_8MT160_300, ROTARY_8MR151
from thermostand.foundation.clock import FollowedClock, to_ns

T0 = 1_700_000_000_000_000_000

# Total sizes of the settings, from the protocol description.
SETTING_SIZES = {
    "mov": 30, "eng": 34, "eds": 26, "hom": 33, "pwr": 20, "sec": 28, "ctp": 18, "ent": 14, "fbs": 18, "nmf": 30,
    "nme": 30, "sti": 70, "sts": 70, "pid": 48, "sni": 28, "sno": 16, "eio": 18, "brk": 25, "ctl": 93, "joy": 22,
    "urt": 16, "net": 38, "pwd": 36, "cal": 118, "nvm": 36, "emf": 48, "eas": 54, "est": 46, "mti": 70, "mts": 112,
    "eni": 70, "ens": 54, "hsi": 70, "hss": 50, "gri": 70, "grs": 58, "acc": 114,
}  # fmt: skip

RUNNING, FAILED = 0x80, 0x40
MOVE, MOVR, LEFT, RIGT, STOP, HOME, LOFT, SSTP = range(1, 9)
POWER_OFF, POWER_NORMAL, POWER_REDUCED = 1, 3, 4
ERRC, ERRD, ERRV, EEPROM, HOMED, ALARM, CTP_ERROR, SWAPPED = 0x1, 0x2, 0x4, 0x10, 0x20, 0x40, 0x80, 0x8000


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
        self.plant = StillPlant(T0)
        self.clock = FollowedClock(T0)
        profile = LINEAR_8MT160_300 if attach == "linear" else ROTARY_8MR151
        self.axis = FakeAxis(self.plant, self.clock, profile, 0x1234, attach, start_steps)
        self.real_s = 0.0
        self.engine = self.axis.engine(lambda: self.real_s)

    def wait(self, duration_s: float) -> None:
        self.clock.follow(self.clock.now_ns() + to_ns(duration_s))

    def ask(self, letters: str, payload: bytes = b"", size: int = 4) -> bytes:
        frame, rest = decode(self.engine.feed(encode(letters, payload)), {letters: max(0, size - 6)})
        assert frame is not None
        assert (frame.damage, rest) == (XimcDamage.NONE, b"")
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
