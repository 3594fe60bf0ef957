"""What a metrologist reads."""
