"""A running stand asked and told from another terminal."""
