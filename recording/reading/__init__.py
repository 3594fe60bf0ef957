"""Sessions back into readings, frames, steps and events."""
