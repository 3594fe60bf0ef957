"""The chamber: heat and cold with their permits, and the compressor."""
