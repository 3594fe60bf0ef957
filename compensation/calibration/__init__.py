"""Calibration of the camera from the target at many table positions, and the target's pose in a calibrated camera."""
