"""What a user writes: the stand, its limits, recipes."""
