"""Climate chambers, a file for each language."""
