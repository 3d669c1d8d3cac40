"""Processes at real pace, and what watches them: children, scheduling probes, a run beside its probes, late decisions attributed to gaps.

Owns what several trials measure with; never decides what is tried and never judges. Linux, with the right to SCHED_FIFO.
"""
