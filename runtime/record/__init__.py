"""Recordings: writing one, in one file or in parts, reading it back, deciding it again.

A recording holds everything that a run saw and decided, in blocks that survive a power cut (docs/reference/formats.md). Start with
`Recorder` to see what is written, with `read_recording` for the way back, and with `replaying.replay` for deciding
again.

>>> from pans.runtime.record import read_recording
>>> read_recording("none.pansrec")
Traceback (most recent call last):
    ...
pans.runtime.errors.UsageError: none.pansrec: cannot be read: No such file or directory
  remedy: check the path and its permissions
"""

from .recorder import PartLimits, Recorder
from .recording import Recording, read_recording

__all__ = ["PartLimits", "Recorder", "Recording", "read_recording"]
