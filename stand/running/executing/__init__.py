"""What a run does next, and does."""
