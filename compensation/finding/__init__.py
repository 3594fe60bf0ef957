"""Markers found in all frames of sessions: piece by piece, side by side, and never twice."""
