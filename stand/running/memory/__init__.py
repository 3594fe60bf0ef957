"""What a run remembers: its state, folded from the journal's entries."""
