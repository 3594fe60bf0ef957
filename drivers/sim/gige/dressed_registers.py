"""The registers of a simulated camera in another camera's clothes: its GenICam file instead of ours.

What the client writes lands in a memory laid out by the file; after each write Aravis says what the file's features
are now, and the camera behind is set to that. Commands are the registers that they write. The bootstrap registers stay
ours.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from thermostand.drivers.framing.aravis_library import AravisError
from thermostand.drivers.sim.gige import gvcp
from thermostand.drivers.sim.gige.camera_registers import BOOTSTRAP_bytes, Registers, largest
from thermostand.drivers.sim.gige.genicam import Feature
from thermostand.drivers.sim.gige.genicam_file import GenicamFile
from thermostand.drivers.sim.gige.genicam_memory import Evaluated
from thermostand.drivers.sim.gige.genicam_start import COMMANDS, TEMPERATURES, reach, start_values
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


class DressedRegisters(Registers):
    """`table` is the camera's own, `file` what the client sees; sizes are those that the file allows. ConfigError when
    the file cannot be played."""

    def __init__(self, table: tuple[Feature, ...], address: str, serial: str, file: GenicamFile) -> None:
        names = {"DeviceVendorName": file.vendor, "DeviceModelName": file.model}
        dressed = tuple(replace(each, default=names.get(each.name, each.default)) for each in table)
        self._file = Evaluated(file)
        self._temperature_degC: float | None = None
        self.unplayed: tuple[str, ...] = ()  # features that no value of their registers makes work
        try:
            super().__init__(dressed, address, serial, file.xml, XML_ADDRESS)
        except (AravisError, ArithmeticError, LookupError, ValueError) as error:  # whatever an odd file brings about
            raise ConfigError(f"the rehearsal cannot play this file: {type(error).__name__} {error}") from error

    @property
    def binning(self) -> tuple[int, int]:
        """As the client has set it, 1 where the file knows none."""
        across, down = (int(self._file.get(name)) if name in self._file.file else 1 for name in BINNING)
        return max(1, across), max(1, down)

    def close(self) -> None:
        """Free what evaluates the file."""
        self._file.close()

    def reset(self) -> None:
        """Every feature to its default, as after power-on."""
        super().reset()
        self._file.memory.restore({})
        self.unplayed = start_values(self._file, self.integer("WidthMax"), self.integer("HeightMax"))
        self._commands = {name: self._command(name) for name in COMMANDS if name in self._file.file}
        self._temperature_degC = None
        self._wear()
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
        if feature.kind != "float" and not 0 <= value <= largest(feature):
            raise ConfigError(
                f"the rehearsal cannot play this file: its {name} is {value:.4g}, as no camera's; is it the file of a "
                "transport layer's module (system, interface, device, data stream), not of a camera?"
            )
        super().put(name, value)

    def covers(self, name: str, address: int, count: int) -> bool:
        """Whether a read of `count` bytes at `address` touches the feature's register."""
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
        given = {name: self._given_by(name, address, len(data)) for name in self._commands}
        for name, register in given.items():  # they clear themselves
            if register and self._commands[name][2]:
                self._file.set(register, 0)
        try:
            changed = self._wear()
        except ConfigError as error:
            raise gvcp.Nack(gvcp.Status.BAD_PARAMETER, str(error)) from error
        return (*changed, *(name for name, register in given.items() if register))

    # ---------------------------------------------------------------------------------------------------- the clothes

    def _registers_of(self, feature: str) -> tuple[str, ...]:
        return self._file.file.registers(feature) if feature in self._file.file else ()

    def _command(self, name: str) -> tuple[str, tuple[str, ...], int]:
        """The node that a command gives its value, the registers that this may write, and the value. Which register it
        is a selector may say that only the client knows (Basler ace 2)."""
        file = self._file.file
        return file.named(name, "pValue"), file.written(name), self._file.command_value(name)

    def _given_by(self, name: str, address: int, count: int) -> str:
        """The register by which that write was the command, "" when it was not; start and stop may be values of one."""
        node, registers, value = self._commands[name]
        for register in registers:
            begin, length = self._file.place(register)
            is_touched = address < begin + length and begin < address + count
            if is_touched and value in (self._file.get(register), self._file.get(node)):
                return register
        return ""

    def _wear(self) -> tuple[str, ...]:
        """Set the camera behind to what the file's features are now; the names of those that changed."""
        changed: list[str] = []
        for name, value in self._worn().items():
            known = self._value(self._table[name])
            if value != known:
                self._put_own(name, value)
                changed.append(name)
        return tuple(changed)

    def _worn(self) -> dict[str, float]:
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
