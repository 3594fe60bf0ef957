"""A stand for a run: claimed, opened, stopped, closed."""
