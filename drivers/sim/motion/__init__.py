"""Simulated motion: stages with their XIMC controllers, and the flap with its USB controller."""
