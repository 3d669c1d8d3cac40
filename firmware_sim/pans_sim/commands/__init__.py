"""Argparse in, exit code out; no computation."""
