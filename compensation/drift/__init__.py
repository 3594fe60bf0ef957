"""Marker centres over temperature -> drift model, and what it gains."""
