"""Who has a stand open, for one run or for days, and what may be asked of it."""
