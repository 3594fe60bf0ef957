"""Cameras, a file for each protocol."""
