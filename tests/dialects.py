"""Small GenICam files, one for each way in which makes of cameras name and build the same features."""

from dataclasses import dataclass

WIDTH, HEIGHT = 64, 48

_HEAD = """<?xml version="1.0" encoding="utf-8"?>
<RegisterDescription ModelName="{name}" VendorName="Dialects" ToolTip="" StandardNameSpace="GEV"
 SchemaMajorVersion="{major}" SchemaMinorVersion="{minor}" SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0"
 SubMinorVersion="0" ProductGuid="5C1B6E0C-6E0B-4C4B-8B52-27C8A3B5F003"
 VersionGuid="5C1B6E0C-6E0B-4C4B-8B52-27C8A3B5F004" xmlns="http://www.genicam.org/GenApi/Version_{major}_{minor}">
<Category Name="Root" NameSpace="Standard"><pFeature>Width</pFeature></Category>
<Port Name="Device" NameSpace="Standard"/>
"""


def register(name: str, address: int, access: str = "RW", kind: str = "IntReg", length: int = 4, more: str = "") -> str:
    return (
        f'<{kind} Name="{name}"><Address>{address:#x}</Address><Length>{length}</Length><AccessMode>{access}'
        f"</AccessMode><pPort>Device</pPort>{more}<Endianess>BigEndian</Endianess></{kind}>\n"
    )


def integer(name: str, address: int, limits: str = "") -> str:
    return f'<Integer Name="{name}"><pValue>{name}Reg</pValue>{limits}</Integer>\n' + register(f"{name}Reg", address)


def floating(name: str, address: int, more: str = "") -> str:
    node = f'<Float Name="{name}"><pValue>{name}Reg</pValue>{more}</Float>\n'
    return node + register(f"{name}Reg", address, kind="FloatReg", length=8)


def command(name: str, address: int, value: int = 1) -> str:
    node = f'<Command Name="{name}"><pValue>{name}Reg</pValue><CommandValue>{value}</CommandValue></Command>\n'
    return node + register(f"{name}Reg", address, "WO")


def choice(name: str, address: int, entries: dict[str, int], more: str = "") -> str:
    listed = "".join(
        f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>' for entry, value in entries.items()
    )
    node = f'<Enumeration Name="{name}">{more}{listed}<pValue>{name}Reg</pValue></Enumeration>\n'
    return node + register(f"{name}Reg", address)


FORMATS = {"Mono8": 0x01080001, "Mono12": 0x01100005, "Mono12Packed": 0x010C0006}
IMAGE = (
    integer("WidthMax", 0xA000)
    + integer("HeightMax", 0xA004)
    + integer("Width", 0xA008, "<Min>16</Min><pMax>WidthMax</pMax><Inc>4</Inc>")
    + integer("Height", 0xA00C, "<Min>16</Min><pMax>HeightMax</pMax><Inc>2</Inc>")
    + integer("PayloadSize", 0xA010)
    + choice("PixelFormat", 0xA014, FORMATS)
)
ACQUISITION = command("AcquisitionStart", 0xA020) + command("AcquisitionStop", 0xA024)
MODE = {"Off": 0, "On": 1}
TRIGGER = choice("TriggerMode", 0xA030, MODE) + command("TriggerSoftware", 0xA03C)
SOURCE = choice("TriggerSource", 0xA038, {"Line1": 0, "Software": 1})
EXPOSURE = floating("ExposureTime", 0xA050, "<Unit>us</Unit>")
STEPS = integer("ExposureTimeRaw", 0xA050)

# IIDC as Point Grey builds it: presence bits, one register for start and stop, a temperature in tenths of a kelvin.
PRESENT = "<pIsImplemented>TriggerPresence</pIsImplemented>"
IIDC = (
    '<StructReg Name="TriggerInq"><Address>0xF0F00530</Address><Length>4</Length><AccessMode>RO</AccessMode>'
    '<pPort>Device</pPort><Endianess>BigEndian</Endianess><StructEntry Name="TriggerPresence"><Bit>0</Bit>'
    "</StructEntry></StructReg>\n"
    + '<Command Name="AcquisitionStart"><pValue>IsoEnable</pValue><CommandValue>1</CommandValue></Command>\n'
    + '<Command Name="AcquisitionStop"><pValue>IsoEnable</pValue><CommandValue>0</CommandValue></Command>\n'
    + register("IsoEnable", 0xF0F00614)
    + choice("TriggerSelector", 0xF0F00830, {"ExposureStart": 0, "ExposureActive": 1}, PRESENT)
    + choice("TriggerMode", 0xF0F00834, MODE, PRESENT)
    + choice("TriggerSource", 0xF0F00838, {"Software": 7, "Line0": 0}, PRESENT)
    + command("TriggerSoftware", 0xF0F0062C)
    + '<Float Name="ExposureTime"><pValue>ExposureSeconds</pValue><Unit>us</Unit></Float>\n'
    + '<Converter Name="ExposureSeconds"><FormulaTo>FROM/1000000</FormulaTo><FormulaFrom>TO*1000000</FormulaFrom>'
    + "<pValue>ExposureReg</pValue></Converter>\n"
    + register("ExposureReg", 0xF0F00918, kind="FloatReg")
    + '<Float Name="DeviceTemperature"><pValue>Celsius</pValue></Float>\n'
    + '<SwissKnife Name="Celsius"><pVariable Name="K">TemperatureReg</pVariable><Formula>(K/10)-273.15</Formula>'
    + "</SwissKnife>\n"
    + register("TemperatureReg", 0xF0F0082C, "RO", "MaskedIntReg", more="<LSB>31</LSB><MSB>20</MSB>")
    + '<Boolean Name="AcquisitionFrameRateEnabled"><pValue>RateOn</pValue></Boolean>\n'
    + register("RateOn", 0xF0F0083C)
    + floating("AcquisitionFrameRate", 0xF0F00968, "<Min>0.1</Min><Max>20</Max>")
)

# As Basler's ace: addresses that a selector in the client's own memory decides, times and temperatures called Abs.
ABS = (
    '<Enumeration Name="TriggerSelector"><EnumEntry Name="AcquisitionStart"><Value>0</Value></EnumEntry>'
    '<EnumEntry Name="FrameStart"><Value>1</Value></EnumEntry><pValue>Selected</pValue></Enumeration>\n'
    + '<Integer Name="Selected"><Value>0</Value></Integer>\n'
    + '<Enumeration Name="TriggerMode"><EnumEntry Name="Off"><Value>0</Value></EnumEntry><EnumEntry Name="On">'
    + "<Value>1</Value></EnumEntry><pValue>ModeReg</pValue></Enumeration>\n"
    + '<IntSwissKnife Name="ModeAt"><pVariable Name="S">Selected</pVariable><Formula>(S = 0) ? 0x40100 : 0x40200'
    + "</Formula></IntSwissKnife>\n"
    + '<IntReg Name="ModeReg"><pAddress>ModeAt</pAddress><Length>4</Length><AccessMode>RW</AccessMode>'
    + "<pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>\n"
    + SOURCE
    + command("TriggerSoftware", 0xA03C)
    + floating("ExposureTimeAbs", 0xA050)
    + floating("TemperatureAbs", 0xA060)
    + choice("TemperatureSelector", 0xA068, {"Coreboard": 1, "Sensorboard": 0})
    + floating("GainAbs", 0xA070)
)


# As Basler's ace 2: one register of each trigger, among which a selector in the client's own memory chooses.
SELECTED = (
    '<Enumeration Name="TriggerSelector"><EnumEntry Name="FrameBurstStart"><Value>0</Value></EnumEntry>'
    '<EnumEntry Name="FrameStart"><Value>3</Value></EnumEntry><pValue>Selected</pValue></Enumeration>\n'
    + '<Integer Name="Selected"><Value>3</Value></Integer>\n'
    + '<Command Name="TriggerSoftware"><pValue>SoftwareOf</pValue><CommandValue>1</CommandValue></Command>\n'
    + '<Integer Name="SoftwareOf"><pIndex>Selected</pIndex><pValueIndexed Index="0">BurstSoftware</pValueIndexed>'
    + '<pValueIndexed Index="3">FrameSoftware</pValueIndexed><pValueDefault>BurstSoftware</pValueDefault></Integer>\n'
    + register("BurstSoftware", 0xB010, "WO")
    + register("FrameSoftware", 0xB014, "WO")
    + '<Enumeration Name="TriggerMode"><EnumEntry Name="Off"><Value>0</Value></EnumEntry><EnumEntry Name="On">'
    + "<Value>1</Value></EnumEntry><pValue>ModeOf</pValue></Enumeration>\n"
    + '<Integer Name="ModeOf"><pIndex>Selected</pIndex><pValueIndexed Index="0">BurstMode</pValueIndexed>'
    + '<pValueIndexed Index="3">FrameMode</pValueIndexed><pValueDefault>BurstMode</pValueDefault></Integer>\n'
    + register("BurstMode", 0xB000)
    + register("FrameMode", 0xB004)
    + SOURCE
)

# As Basler's scout: raw steps of a base that counts the ticks of a clock, and a trigger whose bit another register and
# the selector decide.
BASE = (
    '<Float Name="ExposureTimeAbs"><pValue>AbsOf</pValue><Unit>us</Unit></Float>\n'
    '<Converter Name="AbsOf"><pVariable Name="B">ExposureTimeBaseAbs</pVariable><FormulaTo>FROM / B</FormulaTo>'
    "<FormulaFrom>TO * B</FormulaFrom><pValue>ExposureTimeRaw</pValue></Converter>\n"
    + integer("ExposureTimeRaw", 0xA050, "<pMin>RawMin</pMin><pMax>RawMax</pMax>")
    + register("RawMin", 0xA0A0, "RO")
    + register("RawMax", 0xA0A4, "RO")
    + '<Float Name="ExposureTimeBaseAbs"><pValue>BaseOf</pValue><Unit>us</Unit></Float>\n'
    + '<Converter Name="BaseOf"><pVariable Name="T">Tick_ns</pVariable><FormulaTo>(FROM * 1000) / T</FormulaTo>'
    + "<FormulaFrom>TO * T / 1000</FormulaFrom><pValue>BaseTicks</pValue></Converter>\n"
    + register("BaseTicks", 0xA0A8)
    + register("Tick_ns", 0xA0AC, "RO")
)
BIT_OF_SELECTED = (
    choice("TriggerSelector", 0xB000, {"AcquisitionStart": 0, "FrameStart": 1})
    + choice("TriggerMode", 0xB004, MODE)
    + SOURCE
    + '<Command Name="TriggerSoftware"><pValue>BitOf</pValue><CommandValue>1</CommandValue></Command>\n'
    + '<IntConverter Name="BitOf"><pVariable Name="I">Implementation</pVariable>'
    + '<pVariable Name="S">TriggerSelectorReg</pVariable>'
    + "<FormulaTo>((I = 1) &amp;&amp; (S = 1)) ? ((FROM &lt;&lt; 31) &amp; 0x80000000) : 0</FormulaTo>"
    + "<FormulaFrom>((I = 1) &amp;&amp; (S = 1)) ? ((TO &amp; 0x80000000) &gt;&gt; 31) : 0</FormulaFrom>"
    + "<pValue>TriggerBits</pValue></IntConverter>\n"
    + register("Implementation", 0xB008)
    + register("TriggerBits", 0xB00C)
)

# As AVT's Mako U: what is written is in steps that a register of the camera tells.
STEPPED = (
    '<Float Name="ExposureTime"><pValue>InSteps</pValue><Unit>us</Unit></Float>\n'
    '<Converter Name="InSteps"><pVariable Name="M">LeastReg</pVariable><pVariable Name="I">StepReg</pVariable>'
    "<FormulaTo>M + I * TRUNC((FROM * 1000 - M + I / 2) / I)</FormulaTo><FormulaFrom>TO * 0.001</FormulaFrom>"
    "<pValue>InStepsReg</pValue></Converter>\n"
    + register("InStepsReg", 0xA050, length=8)
    + register("LeastReg", 0xA0B0, "RO", length=8)
    + register("StepReg", 0xA0B8, "RO", length=8)
)
# As Hikrobot's: what a command writes is the selector's value, which the client has.
COMMAND_OF_SELECTED = (
    '<Enumeration Name="TriggerSelector"><EnumEntry Name="AcquisitionStart"><Value>0</Value></EnumEntry>'
    '<EnumEntry Name="FrameStart"><Value>3</Value></EnumEntry><pValue>Selected</pValue></Enumeration>\n'
    + '<Integer Name="Selected"><Value>0</Value></Integer>\n'
    + choice("TriggerMode", 0xB004, MODE)
    + SOURCE
    + '<Command Name="TriggerSoftware"><pValue>SoftwareReg</pValue><pCommandValue>Selected</pCommandValue></Command>\n'
    + register("SoftwareReg", 0xB010, "WO")
)
# As IDS' USB3 cameras: registers where GigE Vision has its bootstrap registers.
LOW = IMAGE.replace("0xa0", "0x2") + choice("AcquisitionMode", 0x218, {"SingleFrame": 0, "Continuous": 2})


@dataclass(frozen=True)
class Dialect:
    """A file's body, settings that it needs, what is used of it (features) or missing from it (a piece of the refusal),
    and its temperature's feature."""

    body: str
    used: str = ""
    missing: str = ""
    temperature: str = ""
    settings: tuple[tuple[str, object], ...] = ()
    schema: tuple[int, int] = (1, 1)

    def xml(self, name: str) -> bytes:
        """The file."""
        major, minor = self.schema
        return (_HEAD.format(name=name, major=major, minor=minor) + self.body + "</RegisterDescription>\n").encode()


STANDARD = IMAGE + ACQUISITION
DIALECTS = {
    "sfnc": Dialect(
        STANDARD + TRIGGER + SOURCE + EXPOSURE + floating("DeviceTemperature", 0xA060) + floating("Gain", 0xA070),
        used="ExposureTime, Gain, Software",
        temperature="DeviceTemperature",
    ),
    "abs": Dialect(
        STANDARD + ABS,
        used="ExposureTimeAbs, GainAbs, FrameStart Software",
        temperature="TemperatureAbs of TemperatureSelector 'Sensorboard'",
        schema=(1, 0),
    ),
    "iidc": Dialect(
        IMAGE + IIDC,
        used="ExposureTime, , ExposureStart Software",
        temperature="DeviceTemperature",
        schema=(1, 0),
    ),
    "iidc free run": Dialect(
        IMAGE + IIDC,
        used="ExposureTime, , AcquisitionFrameRate",
        temperature="DeviceTemperature",
        settings=(("trigger", "free_run"), ("frame_rate_hz", 10.0)),
    ),
    "selected": Dialect(STANDARD + SELECTED + EXPOSURE, used="ExposureTime, , FrameStart Software"),
    "ticks of a clock": Dialect(STANDARD + BIT_OF_SELECTED + BASE, used="ExposureTimeAbs, , FrameStart Software"),
    "steps of a register": Dialect(STANDARD + TRIGGER + SOURCE + STEPPED, used="ExposureTime, , Software"),
    "command of a selector": Dialect(
        STANDARD + COMMAND_OF_SELECTED + EXPOSURE, used="ExposureTime, , FrameStart Software"
    ),
    "low registers": Dialect(LOW + ACQUISITION + TRIGGER + SOURCE + EXPOSURE, used="ExposureTime, , Software"),
    "whole us": Dialect(
        STANDARD + TRIGGER + integer("ExposureTimeAbs", 0xA050) + integer("CurrentTemperature", 0xA060),
        used="ExposureTimeAbs, , TriggerSoftware",
        temperature="CurrentTemperature",
    ),
    "raw with a unit": Dialect(
        STANDARD + TRIGGER + integer("ExposureTimeRaw", 0xA050, "<Unit>ms</Unit>") + integer("GainRaw", 0xA070),
        used="ExposureTimeRaw x 0.001 s, GainRaw, TriggerSoftware",
    ),
    "raw with a base": Dialect(
        STANDARD + TRIGGER + STEPS + floating("ExposureTimeBaseAbs", 0xA058),
        used="ExposureTimeRaw x 2e-05 s, , TriggerSoftware",
    ),
    "raw with a step": Dialect(
        STANDARD + TRIGGER + STEPS,
        used="ExposureTimeRaw x 1e-05 s, , TriggerSoftware",
        settings=(("exposure_step_s", 1e-5),),
    ),
    "packed": Dialect(
        STANDARD + TRIGGER + SOURCE + EXPOSURE,
        used="ExposureTime, , Software",
        settings=(("pixel_format", "Mono12Packed"),),
    ),
    "raw without": Dialect(
        STANDARD + TRIGGER + STEPS, missing="its ExposureTimeRaw states no unit; give exposure_step_s"
    ),
    "no exposure": Dialect(STANDARD + TRIGGER, missing="no ExposureTime and no ExposureTimeAbs and no ExposureTimeRaw"),
    "no trigger": Dialect(STANDARD + EXPOSURE, missing="no TriggerMode"),
    "no software": Dialect(
        STANDARD + choice("TriggerMode", 0xA030, MODE) + floating("AcquisitionFrameRate", 0xA080) + EXPOSURE,
        missing="no TriggerSoftware: it has no software trigger; take trigger: free_run",
    ),
    "no line": Dialect(
        STANDARD + TRIGGER + choice("TriggerSource", 0xA038, {"Line1": 0}) + EXPOSURE,
        missing="no TriggerSource Software; it offers Line1",
    ),
    "no rate": Dialect(
        STANDARD + TRIGGER + EXPOSURE,
        missing="no AcquisitionFrameRate and no AcquisitionFrameRateAbs: it keeps no rate of ours; take trigger",
        settings=(("trigger", "free_run"),),
    ),
    "no format": Dialect(
        STANDARD + TRIGGER + EXPOSURE, missing="no PixelFormat Mono10, only", settings=(("pixel_format", "Mono10"),)
    ),
    "no binning": Dialect(
        STANDARD + TRIGGER + EXPOSURE, missing="no BinningHorizontal, and 2 was asked for", settings=(("binning", 2),)
    ),
    "no offset": Dialect(
        STANDARD + TRIGGER + EXPOSURE, missing="no OffsetX, and 8 was asked for", settings=(("offset_x_px", 8),)
    ),
    "no start": Dialect(IMAGE + TRIGGER + EXPOSURE, missing="no AcquisitionStart, without which there are no frames"),
}
