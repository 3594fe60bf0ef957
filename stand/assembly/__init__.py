"""A stand made of its devices: what drives, polls and guards them, or the simulated laboratory in their place."""
