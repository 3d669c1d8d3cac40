"""Fitting a bundle to the instrument that it runs on, by the clicks of labelled objects: what decides, and what is shown.

`pans refit`: recordings and labels in, a bundle with a corrected table, head or automaton out, chosen by held-out log loss. `pans tune`:
patterns moved on the device itself, step by step, each accepted by a test on the same objects. Numpy only: a lab's computer needs no torch.
Start reading in command.py and choosing.py; evidence.py has the mathematics, tune.py the search on the device.
"""
