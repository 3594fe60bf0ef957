"""A night on the disk: MCAP segments that survive whatever ends it, and everything that reads them again."""
