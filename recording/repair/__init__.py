"""Is a session whole, and what can be had of one that is not."""
