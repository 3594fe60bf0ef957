"""Whether anything may move or heat: what has tripped, what holds, and the one owner of the safe state."""
