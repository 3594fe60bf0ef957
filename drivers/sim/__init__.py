"""The simulated laboratory: one physics model behind fake devices that speak the real wire protocols."""
