"""A USB3 Vision camera: the same driver over Aravis' other transport. No unit was seen, and no fake of one exists."""

from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.wires.camera_settings import Usb3CameraSettings

Camera = AravisCamera
Settings = Usb3CameraSettings
