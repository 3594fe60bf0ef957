"""Simulated units that answer requests on a bus or line: regulator, chambers, relays, thermometers, imager."""
