"""What Aravis reports of a camera, as the stand's own errors."""

from __future__ import annotations

from thermostand.drivers.framing.aravis_library import DEVICE_ERRORS, GENICAM_ERRORS, AravisError
from thermostand.foundation.errors import DeviceError, Refused, Unreachable

# Codes of arv-device-error-quark.
SILENT = {2, 4, 5, 6}  # not connected, transfer error, timeout, device not found
# Genicam data not found, no stream channel, busy: what a camera says, or Aravis for it, while it restarts. Every GigE
# Vision camera has its data and a stream channel; Aravis (arvgvdevice.c) takes a count it could not read for 0.
NOT_READY = {8, 9, 18}
EVALUATION_ERRORS = "Aravis"  # the domain of arvevaluator.c
NO_CONTROL = {10, 17}  # not controller, access denied
NO_CONTROL_HINT = "another client controls the camera, or one that died holds it until the heartbeat times out"


def lacks_control(error: AravisError) -> bool:
    """Return whether it failed because we do not, or no longer, control the camera."""
    return error.domain == DEVICE_ERRORS and error.code in NO_CONTROL


def is_silence(error: AravisError) -> bool:
    """Return whether the camera did not answer, in time or at all, or answered while it was not ready yet."""
    return error.domain == DEVICE_ERRORS and error.code in SILENT | NOT_READY


def device_error(name: str, error: AravisError) -> DeviceError:
    """The stand's error for what Aravis reported."""
    if error.domain == DEVICE_ERRORS:
        if is_silence(error):
            return Unreachable(name, str(error))
        if lacks_control(error):
            return Refused(name, f"{error} ({NO_CONTROL_HINT})")
        return Refused(name, f"{error} (Aravis device error {error.code})")
    if error.domain == GENICAM_ERRORS:
        return Refused(name, f"{error} (GenICam error {error.code})")
    if error.domain == EVALUATION_ERRORS:
        return Refused(name, f"{error}: a formula of the camera's own description cannot be evaluated")
    return Unreachable(name, f"{error} ({error.domain} {error.code})")  # the host's network refused
