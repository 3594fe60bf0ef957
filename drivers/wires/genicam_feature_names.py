"""What cameras call the same thing: GenICam feature names of the makes, the first that a camera offers is taken.

Names follow the SFNC (Standard Features Naming Convention) and the GenICam files of the makes named; the makes are
examples. Nothing here is code: another make is another word in a row.
"""

from __future__ import annotations

# Exposure time; the first two are in us by the SFNC, a raw one is in steps (see EXPOSURE_STEPS).
EXPOSURE = ("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw")  # SFNC 2 · Basler, AVT, Prosilica, PCO · PSL
EXPOSURE_RAW = "ExposureTimeRaw"
EXPOSURE_STEP_US = ("ExposureTimeBaseAbs",)  # us per raw step: Basler
TIME_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}  # of a raw exposure that has one

GAIN_DB = ("Gain", "GainAbs")  # a Float; SFNC 2 · Baumer TXG, SVS
GAIN_RAW = ("GainRaw", "Gain")  # steps: Basler, JAI, PSL, Prosilica GC1280 · Sony
FRAME_RATE_AUTO = "AcquisitionFrameRateAuto"
AUTOMATICS = ("ExposureAuto", "GainAuto", FRAME_RATE_AUTO)  # to be "Off"
TIMED = ("ExposureMode", "Timed")  # else the trigger's width may be the exposure

FRAME_RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")  # SFNC 2 · Basler, AVT, Prosilica
FRAME_RATE_ON = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")  # SFNC 2 · Point Grey

# Entries of TriggerSelector that start a frame, and of TriggerSource that stand for TriggerSoftware or a fixed rate.
FRAME_TRIGGERS = ("FrameStart", "FrameBurstStart", "ExposureStart", "AcquisitionStart")  # SFNC · Point Grey, PCO · piA
SOFTWARE_SOURCES = ("Software", "SoftwareTrigger", "SoftTrigger")  # SFNC · Baumer TXG · PCO
FIXED_RATE_SOURCES = ("FixedRate",)  # AVT, Prosilica: the frame rate holds for this source only

# The sensor's size with the binning in force, then without.
WIDTH_MAX, HEIGHT_MAX = ("WidthMax", "SensorWidth"), ("HeightMax", "SensorHeight")
BINNING = ("BinningHorizontal", "BinningVertical")

# A temperature, and the selector that goes before it where there is one.
TEMPERATURES = (
    ("DeviceTemperature", "DeviceTemperatureSelector"),  # SFNC 2; Point Grey and Sony have no selector
    ("TemperatureAbs", "TemperatureSelector"),  # Basler ace
    ("CurrentTemperature", ""),  # Baumer TXG
)
TEMPERATURE_ENTRIES = ("Sensor", "Sensorboard", "SensorBoard", "Mainboard", "Coreboard")  # the nearest to the sensor

# Without these nothing can be done with a camera; what else is missing is reported where it is needed.
NECESSARY = ("Width", "Height", "PixelFormat", "PayloadSize", "AcquisitionStart", "AcquisitionStop")

# Vendor, model, serial number, version of a camera without bootstrap registers of ours: USB3 Vision.
IDENTITY = (
    ("DeviceVendorName",),
    ("DeviceModelName",),
    ("DeviceSerialNumber", "DeviceID"),
    ("DeviceFirmwareVersion", "DeviceVersion"),
)
