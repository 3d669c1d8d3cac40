"""Measure the instrument, and fit a bundle to it.

In: clicks of known patterns and of labelled objects. Out: a calibration, a registration of the optics, a corrected bundle.
Other rooms import measurement, estimate, registration and refit.
Start at measurement.py, then registration/measure.py and refit/choosing.py.
"""
