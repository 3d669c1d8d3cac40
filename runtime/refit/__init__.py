"""Fitting a bundle to the instrument that it runs on, by the clicks of labelled objects: what decides, and what is shown.

Owns `pans refit` (recordings and labels to a corrected table, head or automaton, chosen by held-out log loss) and `pans tune` (patterns
moved on the device itself, step by step, each accepted by a test on the same objects). Numpy only: a lab's computer needs no torch. Trials
run through the ordinary driver and loop; nothing here talks to a device by itself.
"""
