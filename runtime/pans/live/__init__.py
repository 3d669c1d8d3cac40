"""One run in real time: receive, decide, record, act, and end; reconnect when the device is lost.

In: an open link, a plan, a core and `RunOptions`. Out: a `RunResult`, and a recording that is complete when the run ends.
Other rooms import loop, options, stop, timing and watch.
Start at loop.py (the whole run), then run.py (one iteration) and receiver.py (what one call of the kernel brought).
"""
