"""Camera and flap, and when a camera is in thermal equilibrium."""
