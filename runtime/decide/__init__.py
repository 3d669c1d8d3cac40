"""Clicks to label and probability: the back ends behind one call."""
