"""Refitting what decides to the instrument that it runs on, from recorded clicks of labelled objects.

Owns the way from recordings and labels to a corrected table, head or automaton, the choice between the old one and its corrections by
held-out log loss, and `pans refit`. Numpy only: a lab's computer refits without torch. Never changes a pattern, and never runs a device.
"""
