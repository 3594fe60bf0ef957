"""The commands of `stand` and what they print."""
