"""Sessions as other files, other times, or parts of themselves."""
