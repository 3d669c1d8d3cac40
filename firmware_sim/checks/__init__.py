"""Books that must agree: what the instrument did against what the host received, recorded and replays.

Owns the comparisons after a simulated run, each of which names what differs; never runs anything. The trials and the tests use them.
"""
