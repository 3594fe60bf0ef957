"""What moves: stages and the flap."""
