"""Runs one after the other, over nights and restarts."""
