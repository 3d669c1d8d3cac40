"""Append-only recordings: write, read, parts."""
