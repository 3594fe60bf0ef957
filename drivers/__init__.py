"""Everything that touches a device; the fake devices live in drivers.sim."""
