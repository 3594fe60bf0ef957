"""The fake controller's own knowledge of XIMC: every request and its size, value ranges, flag bits, stage profiles.

Typed from the protocol description (libximc protocol.xi) and the vendor's stage profiles, never from our driver.
Payloads are little endian and packed; `x` are reserved bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

from thermostand.drivers.sim.motion.stepper import LimitSwitches

# Commands that only act; the request carries this payload and the reply is the bare letters.
ACTIONS: Mapping[str, str] = dict.fromkeys(
    ("home", "left", "rigt", "loft", "stop", "sstp", "zero", "pwof", "save", "read", "stms"), ""
) | {
    "spos": "<ihqB5x",  # position, microsteps, encoder, flags: 1 leaves the position, 2 the encoder
    "move": "<ih6x",  # target in steps and microsteps
    "movr": "<ih6x",  # shift of the target
    "asia": "<ihI6x",
    "sars": "",
    "rers": "",
    "eesv": "",
    "eerd": "",
}

# Commands without request payload and the payload they are answered with.
QUERIES: Mapping[str, str] = {
    "gets": "<BBBBBihqih5hIIB4x",
    "gpos": "<ihq6x",
    "getm": "<25i25iI6x",
    "geti": "<4s2s8sBBH12x",
    "gser": "<I",
    "gfwv": "<BBH",
    "gblv": "<BBH",
    "getc": "<6hHHh14x",
    "guid": "<4I18x",
    "rdan": "<13H13hHii8x",
}

# Settings: g... reads and s... writes the same payload. A size instead of a structure: kept, but not understood here.
SETTINGS: Mapping[str, str] = {
    "mov": "<IBHHIBB9x",  # Speed, uSpeed, Accel, Decel, AntiplaySpeed, uAntiplaySpeed, MoveFlags
    "eng": "<HHIBHhBH12x",  # NomVoltage, NomCurrent, NomSpeed, uNomSpeed, Flags, Antiplay, MicrostepMode, StepsPerRev
    "eds": "<BBihih6x",  # BorderFlags, EnderFlags, LeftBorder, uLeftBorder, RightBorder, uRightBorder
    "hom": "<IBIBihH9x",  # FastHome, uFastHome, SlowHome, uSlowHome, HomeDelta, uHomeDelta, HomeFlags
    "pwr": "<BHHHB6x",  # HoldCurrent, CurrReductDelay, PowerOffDelay, CurrentSetTime, PowerFlags
    "sec": "<7HB7x",  # LowUpwrOff, CriticalIpwr, -Upwr, -T, -Iusb, -Uusb, MinimumUusb, Flags
    "ctp": "<BB10x",  # CTPMinError, CTPFlags
    "ent": "<BB6x",  # EngineType, DriverType
    "fbs": "<HBBI4x",  # IPS, FeedbackType, FeedbackFlags, CountsPerTurn
    "nmf": "<16sB7x",
    "nme": "<16s8x",
    "sti": "<16s24s24x",
    "sts": "<f8s7f24x",
} | {
    name: f"<{size - 6}s"
    for name, size in {
        "pid": 48, "sni": 28, "sno": 16, "eio": 18, "brk": 25, "ctl": 93, "joy": 22, "urt": 16, "net": 38, "pwd": 36,
        "cal": 118, "nvm": 36, "emf": 48, "eas": 54, "est": 46, "mti": 70, "mts": 112, "eni": 70, "ens": 54, "hsi": 70,
        "hss": 50, "gri": 70, "grs": 58, "acc": 114,
    }.items()
}  # fmt: skip

# Firmware and service requests by total size: swallowed whole and answered `errc`.
SERVICE_SIZES: Mapping[str, int] = {
    "sser": 50, "dbgr": 4, "dbgw": 142, "updf": 4, "clfr": 4, "gofw": 4, "hasf": 4, "wkey": 46, "conn": 14, "disc": 14,
    "wdat": 142, "rest": 4, "irnd": 4,
}  # fmt: skip

REQUEST_SIZES: Mapping[str, int] = (
    {letters: struct.calcsize(layout) for letters, layout in ACTIONS.items()}
    | dict.fromkeys(QUERIES, 0)
    | {"g" + name: 0 for name in SETTINGS}
    | {"s" + name: struct.calcsize(layout) for name, layout in SETTINGS.items()}
    | {letters: max(0, size - 6) for letters, size in SERVICE_SIZES.items()}
)

# Allowed values by setting and index of the field; others are corrected to the nearest and answered `errv`.
RANGES: Mapping[str, Mapping[int, tuple[int, int]]] = {
    "mov": {0: (0, 100_000), 2: (1, 65_535), 3: (1, 65_535), 4: (0, 100_000)},
    "eng": {1: (15, 8_000), 2: (1, 100_000), 6: (1, 9), 7: (1, 65_535)},
    "hom": {0: (0, 100_000), 2: (0, 100_000)},
    "pwr": {0: (0, 100)},
}

COMMAND_CODES: Mapping[str, int] = {
    "move": 1, "movr": 2, "left": 3, "rigt": 4, "stop": 5, "home": 6, "loft": 7, "sstp": 8,
}  # fmt: skip
MVCMD_ERROR, MVCMD_RUNNING = 0x40, 0x80
MOVE_STATE_MOVING, MOVE_STATE_TARGET_SPEED, MOVE_STATE_ANTIPLAY = 1, 2, 4
PWR_OFF, PWR_NORMAL, PWR_REDUCED = 1, 3, 4
WINDINGS_OK = 0x33

FLAG_ERRC, FLAG_ERRD, FLAG_ERRV = 0x1, 0x2, 0x4
FLAG_EEPROM_CONNECTED, FLAG_IS_HOMED, FLAG_ALARM, FLAG_CTP_ERROR = 0x10, 0x20, 0x40, 0x80
FLAG_BORDERS_SWAP_MISSET = 0x8000
FLAG_DRIVER_OVERHEAT, FLAG_WINDING_MISMATCH = 0x100, 0x100000
GPIO_RIGHT_EDGE, GPIO_LEFT_EDGE = 0x1, 0x2

MOVE_THOUSANDTHS = 0x1  # of MoveFlags
POWER_REDUCE, POWER_OFF = 0x1, 0x2
BORDER_BY_VALUE, BORDER_STOP_LEFT, BORDER_STOP_RIGHT = 0x1, 0x2, 0x4
HOME_FIRST_RIGHT, HOME_SECOND_RIGHT, HOME_SECOND_PHASE = 0x1, 0x2, 0x4
HOME_STOP_LIMIT = 0x3  # of the two selector bits, shifted down: 1 revolution sensor, 2 sync input, 3 limit switch
SECURE_ALARM_ON_BORDERS = 0x8
ENGINE_LIMIT_SPEED = 0x80
SPOS_LEAVE_POSITION, SPOS_LEAVE_ENCODER = 0x1, 0x2

# What GETS shows of the controller's own state in this laboratory.
SUPPLY_10mV, USB_10mV, USB_mA, PROCESSOR_0_1degC, COMMAND_QUEUE_FREE = 2_400, 500, 60, 350, 255


@dataclass(frozen=True, slots=True)
class Profile:
    """A stage and the settings its controller was delivered with. Mechanical zero is the homed position: where the
    switch and HomeDelta leave the stage. `unit_per_step` is mm or degrees."""

    name: str
    unit_per_step: float
    switches: LimitSwitches
    settings: Mapping[str, tuple[int | bytes | float, ...]]


SECURITY = (800, 4_000, 5_500, 800, 450, 520, 420, 0x9D)

LINEAR_8MT160_300 = Profile(
    name="8MT160-300",
    unit_per_step=0.0025,
    switches=LimitSwitches(left=-500, right=119_500),
    settings={
        "mov": (1_000, 0, 2_000, 4_000, 1_000, 0, 0),
        "eng": (1, 1_200, 3_200, 0, 0x91, 575, 9, 200),
        "eds": (6, 7, 2_500, 0, 116_500, 0),
        "hom": (500, 0, 500, 0, 500, 0, 0x172),
        "pwr": (50, 1_000, 60, 300, 7),
        "sec": SECURITY,
        "ctp": (3, 0x10),
        "ent": (3, 2),
        "fbs": (4_000, 5, 0x40, 4_000),
        "nmf": (b"", 0),
        "nme": (b"8MT160-300",),
        "sti": (b"Standa", b"8MT160-300"),
        "sts": (0.5, b"mm", 8.0, 300.0, 12.0, 36.0, 1.2, 0.0, 0.0),
    },
)

ROTARY_8MR151 = Profile(
    name="8MR151",
    unit_per_step=0.01,
    switches=LimitSwitches(left=1_250, right=None, turn_steps=36_000),
    settings={
        "mov": (2_000, 0, 2_000, 5_000, 2_000, 0, 0),
        "eng": (360, 670, 5_000, 0, 0x90, 1_800, 9, 200),
        "eds": (0, 0, -33_850, 0, 350, 0),
        "hom": (100, 0, 10, 0, -1_250, 0, 0x172),
        "pwr": (50, 1_000, 60, 300, 5),
        "sec": SECURITY,
        "ctp": (3, 0x10),
        "ent": (3, 2),
        "fbs": (4_000, 4, 0x40, 4_000),
        "nmf": (b"", 0),
        "nme": (b"8MR151-30",),
        "sti": (b"Standa", b"8MR151-30"),
        "sts": (2.0, b"deg", 50.0, 360.0, 12.0, 36.0, 0.67, 0.0, 0.0),
    },
)
