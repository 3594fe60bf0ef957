"""A run as it is shown at a terminal."""
