"""Where the target stands: the stages."""
