"""A run as whoever sits at the terminal sees it."""
