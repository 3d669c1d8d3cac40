"""One run in real time: receive, decide, record, act, and end; reconnect when the device is lost.

In: an open link, a `Job` and a core. Out: a `RunResult`, and a recording that is complete when the run ends.
Other rooms import loop, options, stop, timing and watch.
Start at loop.py (the whole run), then stream.py (what happens to each batch) and receiver.py (where batches come from).
"""
