"""A trained sensor in one file: patterns or optics, and the back end that turns clicks into a label.

In: a bundle file, or patterns and a head from a trainer. Out: a `Bundle`, a back end for it, exact expectations.
Other rooms import sensor, automaton, backends, heads and making.
Start at sensor/facts.py (what a bundle is), then backends/choose.py (which back end decides).
"""
