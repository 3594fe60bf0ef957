"""What can be had of a session that is not whole."""
