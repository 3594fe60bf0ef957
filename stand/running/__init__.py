"""One run: from its first step to a safe stand, also after a kill."""
