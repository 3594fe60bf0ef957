"""The SECoP node: chamber, thermometers, flap, stages and runs for sample-environment programs, on this machine."""
