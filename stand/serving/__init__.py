"""A running stand queried and controlled from another terminal."""
