"""A run on disk: write it while it happens, read it back, decide it again, export it.

In: messages, decisions and commands of a run. Out: a recording that survives a power cut, tables, exports, replayed decisions.
Other rooms import recorder, reading, replay and tables. The file format is in docs/reference/formats.md.
Start at recorder.py (what is written), then reading/recording.py (the way back).
"""
