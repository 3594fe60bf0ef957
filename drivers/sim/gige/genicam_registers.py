"""The registers of a simulated camera in another camera's clothes: its GenICam file instead of ours.

What the client writes lands in a memory laid out by the file; after each write Aravis says what the file's features
are now, and the camera behind is set to that. Commands are the registers that they write. The bootstrap registers stay
ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace

from thermostand.drivers.framing.aravis_library import AravisError
from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.camera_registers import BOOTSTRAP_bytes, Registers, get_largest
from thermostand.drivers.sim.gige.genicam import Feature
from thermostand.drivers.sim.gige.genicam_file import EvaluatedFile, GenicamFile
from thermostand.drivers.sim.gige.gvsp import PixelFormat
from thermostand.foundation.errors import ConfigError

XML_ADDRESS = 0x7E000000  # no register of the makes known lies there

# Ours from theirs, the first that the file has: names of the makes as their GenICam files give them.
_NUMBERS = {
    "Width": ("Width",),
    "Height": ("Height",),
    "OffsetX": ("OffsetX",),
    "OffsetY": ("OffsetY",),
    "ExposureTime": ("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw"),
    "Gain": ("Gain", "GainAbs"),
    "AcquisitionFrameRateEnable": ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled"),
    "AcquisitionFrameRate": ("AcquisitionFrameRate", "AcquisitionFrameRateAbs"),
}
_SOFTWARE = ("Software", "SoftwareTrigger", "SoftTrigger")
BINNING = ("BinningHorizontal", "BinningVertical")
_PACED = ("FixedRate", "Freerun")  # sources of a trigger that is none


class GenicamRegisters(Registers):
    """`table` is the camera's own, `file` what the client sees; sizes are those that the file allows. ConfigError when
    the file cannot be played."""

    def __init__(self, table: tuple[Feature, ...], address: str, serial: str, file: GenicamFile) -> None:
        names = {"DeviceVendorName": file.vendor, "DeviceModelName": file.model}
        dressed = tuple(replace(each, default=names.get(each.name, each.default)) for each in table)
        self._file = EvaluatedFile(file)
        self._temperature_degC: float | None = None
        self.unplayed: tuple[str, ...] = ()  # features that no value of their registers makes work
        try:
            super().__init__(dressed, address, serial, file.xml, XML_ADDRESS)
        except (AravisError, ArithmeticError, LookupError, ValueError) as error:  # whatever an odd file brings about
            raise ConfigError(f"the rehearsal cannot play this file: {type(error).__name__} {error}") from error

    @property
    def binning(self) -> tuple[int, int]:
        """The binning as the client has set it, 1 where the file knows none."""
        across, down = (int(self._file.get(name)) if name in self._file.file else 1 for name in BINNING)
        return max(1, across), max(1, down)

    def close(self) -> None:
        """Free what evaluates the file."""
        self._file.close()

    def reset(self) -> None:
        """Every feature to its default, as after power-on."""
        super().reset()
        self._file.memory.restore({})
        self.unplayed = initialize_values(self._file, self.integer("WidthMax"), self.integer("HeightMax"))
        self._commands = {name: self._command(name) for name in COMMANDS if name in self._file.file}
        self._temperature_degC = None
        self._apply_features()
        self.put("PayloadSize", self.integer("Width") * self.integer("Height"))

    def put(self, name: str, value: float) -> None:
        """Set a feature from inside: no access rules. What the client may read shows it, too."""
        self._put_own(name, value)
        if name == "PayloadSize" and name in self._file.file:
            sizes = {register for each in ("Width", "Height") for register in self._file.file.registers(each)}
            reach(self._file, name, value, sizes)
        if name == "DeviceTemperature" and value != self._temperature_degC:
            self._temperature_degC = value
            for feature in TEMPERATURES:
                if feature in self._file.file:
                    reach(self._file, feature, value)

    def _put_own(self, name: str, value: float) -> None:
        """ConfigError when it does not fit: the file is not of a camera."""
        feature = self._table[name]
        if feature.kind != "float" and not 0 <= value <= get_largest(feature):
            raise ConfigError(
                f"the rehearsal cannot play this file: its {name} is {value:.4g}, as no camera's; is it the file of a "
                "transport layer's module (system, interface, device, data stream), not of a camera?"
            )
        super().put(name, value)

    def covers(self, name: str, address: int, count: int) -> bool:
        """Return whether a read of `count` bytes at `address` touches the feature's register."""
        if name != "DeviceTemperature":
            return super().covers(name, address, count)
        places = [self._file.place(register) for each in TEMPERATURES for register in self._registers_of(each)]
        return any(address < begin + length and begin < address + count for begin, length in places)

    def read(self, address: int, count: int) -> bytes:
        """`count` bytes from `address`, zeros where nothing was written yet. Registers of a file for another bus lie
        among the bootstrap registers."""
        is_in_xml = XML_ADDRESS <= address < XML_ADDRESS + len(self._file.file.xml) + 4
        if self.is_bootstrap(address, count) or is_in_xml:
            return super().read(address, count)
        return self._file.memory.read(address, count)

    def write(self, address: int, data: bytes) -> tuple[str, ...]:
        """Write; the names of our features that changed and of the commands that were given."""
        if address in self._at and address < BOOTSTRAP_bytes:
            return super().write(address, data)
        self._file.memory.write(address, data)
        given = {name: self._find_command_register(name, address, len(data)) for name in self._commands}
        for name, register in given.items():  # they clear themselves
            if register and self._commands[name][2]:
                self._file.set(register, 0)
        try:
            changed = self._apply_features()
        except ConfigError as error:
            raise gvcp.Nack(gvcp.GvcpStatus.BAD_PARAMETER, str(error)) from error
        return (*changed, *(name for name, register in given.items() if register))

    # ---------------------------------------------------------------------------------------------------- the clothes

    def _registers_of(self, feature: str) -> tuple[str, ...]:
        return self._file.file.registers(feature) if feature in self._file.file else ()

    def _command(self, name: str) -> tuple[str, tuple[str, ...], int]:
        """The node that a command gives its value, the registers that this may write, and the value. Which register it
        is a selector may say that only the client knows (Basler ace 2)."""
        file = self._file.file
        return file.find_named(name, "pValue"), file.written(name), self._file.command_value(name)

    def _find_command_register(self, name: str, address: int, count: int) -> str:
        """The register by which that write was the command, "" when it was not; start and stop may be values of one."""
        node, registers, value = self._commands[name]
        for register in registers:
            begin, length = self._file.place(register)
            is_touched = address < begin + length and begin < address + count
            if is_touched and value in (self._file.get(register), self._file.get(node)):
                return register
        return ""

    def _apply_features(self) -> tuple[str, ...]:
        """Set the camera behind to what the file's features are now; the names of those that changed."""
        changed: list[str] = []
        for name, value in self._read_features().items():
            known = self._value(self._table[name])
            if value != known:
                self._put_own(name, value)
                changed.append(name)
        return tuple(changed)

    def _read_features(self) -> dict[str, float]:
        """Our features as the client set theirs."""
        file, worn = self._file.file, dict[str, float]()
        for name, theirs in _NUMBERS.items():
            feature = next((each for each in theirs if each in file), None)
            if feature is not None:
                with suppress(AravisError):
                    worn[name] = self._file.get(feature)
        if "AcquisitionFrameRateEnable" not in worn and "AcquisitionFrameRate" in worn:
            worn["AcquisitionFrameRateEnable"] = 1
        entry = self._file.entry("PixelFormat").upper()
        if entry in PixelFormat.__members__:
            worn["PixelFormat"] = PixelFormat[entry]
        source = self._file.entry("TriggerSource") if "TriggerSource" in file else _SOFTWARE[0]
        worn["TriggerSource"] = int(source not in _SOFTWARE)
        if "TriggerMode" in file:
            worn["TriggerMode"] = int(self._file.entry("TriggerMode") == "On" and source not in _PACED)
        if "AcquisitionMode" in file:
            worn["AcquisitionMode"] = int(self._file.entry("AcquisitionMode") == "SingleFrame")
        return worn


# Sensible start values of a camera whose file is known and whose registers are not.
#
# A feature is there when the registers that say so do; a value is what its registers make of it. Where Aravis cannot
# write a node (a formula has no inverse), the registers it is made of are tried until it evaluates as wanted.


# What a camera of these wants is there: enumerations with the entries that matter, from the GenICam files of 12 makes.
ENTRIES = {
    "PixelFormat": ("Mono8", "Mono10", "Mono12", "Mono16", "Mono10Packed", "Mono12Packed", "Mono10p", "Mono12p"),
    "AcquisitionMode": ("Continuous", "SingleFrame"),
    "TriggerSelector": ("FrameStart", "FrameBurstStart", "ExposureStart", "AcquisitionStart"),
    "TriggerMode": ("Off", "On"),
    "TriggerSource": ("Software", "SoftwareTrigger", "SoftTrigger", "FixedRate"),
    "ExposureMode": ("Timed",),
    "ExposureAuto": ("Off",),
    "GainAuto": ("Off",),
    "AcquisitionFrameRateAuto": ("Off",),
    "GainSelector": ("All", "AnalogAll"),
    "DeviceTemperatureSelector": ("Sensor", "Mainboard"),
    "TemperatureSelector": ("Sensorboard", "Coreboard"),
}
_OF_A_CAMERA = ("Width", "Height", "PixelFormat", "PayloadSize")  # what lacks one of them is refused for that
_USUAL = "Mono8"
COMMANDS = ("AcquisitionStart", "AcquisitionStop", "TriggerSoftware")
TEMPERATURES = ("DeviceTemperature", "TemperatureAbs", "CurrentTemperature")
AMBIENT_degC = 40.0

# Feature: value, minimum, maximum, increment; None for the sensor's width or height.
Wish = tuple[float | None, float | None, float | None, float]
Limit = tuple[str, float]
WISHES: dict[str, Wish] = {
    **dict.fromkeys(("SensorWidth", "WidthMax", "SensorHeight", "HeightMax"), (None, None, None, 1)),
    **dict.fromkeys(("BinningHorizontal", "BinningVertical"), (1, 1, 4, 1)),
    **dict.fromkeys(("OffsetX", "OffsetY"), (0, 0, None, 1)),
    **dict.fromkeys(("Width", "Height"), (None, 16, None, 4)),
    "ExposureTimeBaseAbs": (20, None, None, 1),
    **dict.fromkeys(("ExposureTime", "ExposureTimeAbs"), (10_000, 20, 10e6, 1)),
    "ExposureTimeRaw": (10_000, 1, 10e6, 1),
    **dict.fromkeys(("Gain", "GainAbs"), (0, 0, 24, 1)),
    "GainRaw": (0, 0, 480, 1),
    **dict.fromkeys(("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled"), (0, None, None, 1)),
    **dict.fromkeys(("AcquisitionFrameRate", "AcquisitionFrameRateAbs"), (10, 0.01, 14, 1)),
    **dict.fromkeys(TEMPERATURES, (AMBIENT_degC, None, None, 1)),
}

WRITTEN = ("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw")

_NEAR, _NEAR_ENOUGH = 1e-3, 0.03  # of a value; the second where a register has coarse steps
_ALL_BITS = 2**32 - 1
_LARGEST_RAW = float(2**31 - 1)  # of a register with a sign
_BISECTIONS = 40
_FILLERS = (1.0, 1e6)  # of a register that a formula multiplies by, or divides by, as a clock's ticks in a second


def initialize_values(camera: EvaluatedFile, width: int, height: int) -> tuple[str, ...]:
    """Put them into the camera's memory: everything known is there, the sensor has width x height px unless the file
    fixes another size. The features that stay at 0, or cannot be evaluated, whatever their registers hold."""
    for names in ((*ENTRIES, *COMMANDS, *WISHES), *[(*ENTRIES, *WISHES)] * 2):  # some are there with a trigger only
        _choose_entries(camera)  # selectors say which registers count
        for condition in dict.fromkeys(_list_conditions(camera, names)):
            _make_true(camera, condition)
        for command in COMMANDS:
            _make_effective(camera, command)
    spared = {register for name in WISHES if name in camera.file for register in camera.file.registers(name)}
    sides = {"Width": float(width), "Height": float(height)}
    for name, (value, lowest, highest, step) in WISHES.items():
        if name not in camera.file or _is_raw_of_another(camera, name):
            continue
        axis = "Height" if "Height" in name or name.endswith("Y") else "Width"
        start = sides[axis] if value is None else value
        reach(camera, name, start)
        for bound, wanted in _list_limits(camera, name, (lowest, sides[axis] if highest is None else highest, step)):
            reach(camera, bound, wanted, spared)
            spared.update(camera.file.registers(bound))
        reach(camera, name, start)
        if name in WRITTEN:
            _make_settable(camera, name, start)
        if value is None and (fixed := _get_value(camera, name) or 0.0) > 0:
            sides[axis] = min(sides[axis], fixed)
    _choose_entries(camera)
    return tuple(_list_unsupported_features(camera))


def _list_unsupported_features(camera: EvaluatedFile) -> Iterator[str]:
    """Features of which the registers do not make what a camera's would; none where the file is no camera's."""
    file = camera.file
    if any(name not in file for name in _OF_A_CAMERA):
        return
    for name, (value, *_) in WISHES.items():
        if name not in file or _is_raw_of_another(camera, name):
            continue
        is_mute = value != 0 and file.registers(name) and not _get_value(camera, name)
        if is_mute or (name in WRITTEN and not _make_settable(camera, name, value or 0.0)):
            yield name
    yield from (name for name in COMMANDS if name in file and not _make_effective(camera, name))
    formats = file.entries("PixelFormat") if file.registers("PixelFormat") else {}
    if _USUAL in formats and camera.entry("PixelFormat") != _USUAL:
        yield "PixelFormat"
    for name in WRITTEN:
        conditions = [each for each in file.conditions(name) if each in file] if name in file else []
        if any(file.registers(each) and not _get_value(camera, each) for each in conditions):
            yield name


def _is_raw_of_another(camera: EvaluatedFile, name: str) -> bool:
    """Return whether a feature is the raw one of another, which is set instead."""
    return name == "ExposureTimeRaw" and "ExposureTimeAbs" in camera.file


def _make_settable(camera: EvaluatedFile, name: str, value: float) -> bool:
    """Have a feature become what is written to it, by the registers that its formula looks at; whether it does. One
    that cannot be written does, too."""
    written = camera.file.written(name)
    if not written or _takes(camera, name, value):
        return True
    unset = [each for each in camera.file.registers(name) if each not in written and not _get_value(camera, each)]
    for filler in _FILLERS if unset else ():
        for register in unset:
            _ignore_errors(camera.set, register, filler)
        if _takes(camera, name, value):
            return True
    for register in unset:
        _ignore_errors(camera.set, register, 0.0)
    reach(camera, name, value)
    return False


def _takes(camera: EvaluatedFile, name: str, value: float) -> bool:
    """Return whether twice the value and the value can be written, or none can."""
    try:
        camera.set(name, 2 * value)
        is_taken = _nearest(camera, name, 2 * value)
        camera.set(name, value)
    except AravisError:
        return True
    return is_taken and _nearest(camera, name, value)


def _make_effective(camera: EvaluatedFile, command: str) -> bool:
    """Have a command change what it writes, by one of the registers that its formula looks at; whether it does."""
    node = camera.file.find_named(command, "pValue") if command in camera.file else ""
    if node not in camera.file:
        return True
    value, looked_at = camera.command_value(command), set(camera.file.registers(node)) - {*camera.file.written(node)}
    if value == 0 or _is_taken(camera, node, value):
        return True
    for register in looked_at:
        before = _get_value(camera, register) or 0.0
        for tried in (1.0, 0.0):
            _ignore_errors(camera.set, register, tried)
            if _is_taken(camera, node, value):
                return True
        _ignore_errors(camera.set, register, before)
    return False


def _is_taken(camera: EvaluatedFile, node: str, value: float) -> bool:
    """Return whether a node shows what is written to it; its registers are then as before."""
    before = {register: _get_value(camera, register) for register in camera.file.written(node)}
    _ignore_errors(camera.set, node, value)
    is_taken = _get_value(camera, node) == value
    for register, was in before.items():
        _ignore_errors(camera.set, register, was or 0.0)
    return is_taken


def _list_limits(camera: EvaluatedFile, name: str, wanted: tuple[float | None, float | None, float]) -> Iterator[Limit]:
    """The nodes that bound a feature, and the raw values behind it, each with what it should be."""
    for node in camera.file.find_reached(name):
        values = wanted if node == name else (1.0, _LARGEST_RAW, 1.0)
        for property_name, value in zip(("pMin", "pMax", "pInc"), values, strict=True):
            bound = camera.file.find_named(node, property_name)
            if value is not None and bound in camera.file and bound not in WISHES:
                yield bound, value


def _choose_entries(camera: EvaluatedFile) -> None:
    for name, entries in ENTRIES.items():
        if name in camera.file and camera.file.kind(name) == "Enumeration":
            offered = camera.file.entries(name)
            first = next((entry for entry in entries if entry in offered and _is_offered(camera, offered[entry])), "")
            if first:
                _ignore_errors(camera.choose, name, first)


def _is_offered(camera: EvaluatedFile, conditions: Iterable[str]) -> bool:
    return all(_get_value(camera, condition) != 0 for condition in conditions if condition in camera.file)


def reach(camera: EvaluatedFile, name: str, value: float, spared: Collection[str] = ()) -> bool:
    """Make a node evaluate to `value`, through its converters or by trying its registers but those spared; whether it
    does."""
    if _is(camera, name, value):
        return True
    own = [register for register in camera.file.registers(name) if register not in spared]
    if not own:  # a constant of the file
        return False
    _ignore_errors(camera.set, name, value)
    if _is(camera, name, value):
        return True
    if any(_try_register(camera, name, register, value) for register in own):
        return True
    unset = [register for register in own if _get_value(camera, register) == 0]
    for filler in _FILLERS if unset else ():
        for register in unset:
            _ignore_errors(camera.set, register, filler)
        _ignore_errors(camera.set, name, value)
        if _is(camera, name, value) or any(_try_register(camera, name, register, value) for register in own):
            return True
    return False


def _try_register(camera: EvaluatedFile, name: str, register: str, value: float) -> bool:
    """Try one register: the value itself, then where a rising or falling formula meets it."""
    before = _get_value(camera, register)
    if before is None:
        return False
    _ignore_errors(camera.set, register, value)
    if _is(camera, name, value):
        return True
    low, high = 1.0, _LARGEST_RAW  # not 0, by which a formula may divide
    ends = [_with(camera, register, end, name) for end in (low, high)]
    if ends[1] is None or ends[1] == ends[0]:  # a register of fewer bits takes no more
        while high > 1 and (ends[1] is None or ends[1] == ends[0]):
            high = (high - 1) / 2
            ends[1] = _with(camera, register, high, name)
    if None not in ends:
        rises = (ends[1] or 0.0) > (ends[0] or 0.0)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            found = _with(camera, register, middle, name)
            if found is None or _is(camera, name, value):
                break
            low, high = (middle, high) if (found < value) == rises else (low, middle)
        if _nearest(camera, name, value):
            return True
    _ignore_errors(camera.set, register, before)
    return False


def _make_true(camera: EvaluatedFile, condition: str) -> None:
    """Make a condition hold, by as few registers as will do."""
    if condition not in camera.file or (_get_value(camera, condition) or 0) != 0:
        return
    registers = camera.file.registers(condition)
    choices: list[tuple[str, ...]] = [*((register,) for register in registers), registers]
    for chosen in choices:
        before = [int(_get_value(camera, register) or 0) for register in chosen]
        for bits in (1, *(1 << bit for bit in range(31, 0, -1)), _ALL_BITS):
            for register, was in zip(chosen, before, strict=True):
                _ignore_errors(camera.set, register, was | bits)  # other conditions are bits of the same register
            if (_get_value(camera, condition) or 0) != 0:
                return
        for register, was in zip(chosen, before, strict=True):
            _ignore_errors(camera.set, register, was)


def _list_conditions(camera: EvaluatedFile, names: Iterable[str]) -> Iterator[str]:
    """List the conditions of everything a camera is used for, entries and limits included."""
    file = camera.file
    for name in names:
        if name not in file:
            continue
        yield from file.conditions(name)
        for entry, conditions in (file.entries(name) if file.kind(name) == "Enumeration" else {}).items():
            if entry in ENTRIES.get(name, ()):
                yield from conditions


def _with(camera: EvaluatedFile, register: str, raw: float, name: str) -> float | None:
    _ignore_errors(camera.set, register, raw)
    return _get_value(camera, name)


def _nearest(camera: EvaluatedFile, name: str, value: float) -> bool:
    """Return whether bisection came as near as a register's steps allow."""
    found = _get_value(camera, name)
    return found is not None and math.isclose(found, value, rel_tol=_NEAR_ENOUGH)


def _is(camera: EvaluatedFile, name: str, value: float) -> bool:
    found = _get_value(camera, name)
    return found is not None and math.isclose(found, value, rel_tol=_NEAR, abs_tol=1e-9)


def _get_value(camera: EvaluatedFile, name: str) -> float | None:
    """The node's value; None when it cannot be evaluated (a register at an address that nothing stands for)."""
    try:
        return camera.get(name)
    except AravisError:
        return None


def _ignore_errors(write: Callable[..., None], *arguments: object) -> None:
    try:
        write(*arguments)
    except AravisError:
        return
