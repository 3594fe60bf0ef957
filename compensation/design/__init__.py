"""Which visit of the chamber teaches a drift model most, and when enough is known: arrays in, a decision out."""
