"""Offline: marker centres, drift models, validation and the report, from recorded sessions only."""
