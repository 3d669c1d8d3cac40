"""The trained artifact: patterns, optics, back end and golden vectors in one file."""
