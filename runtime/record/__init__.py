"""Append-only recordings: writing one as a whole or in parts, reading it back, deciding it again.

Owns the file format (docs/reference/formats.md) and the way from a recording to a core. Everything a run saw and decided is in one file
that survives a power cut; never judges what is in it (report) and never runs a device (live).

>>> from pans.runtime.record import read_recording
>>> read_recording("none.pansrec")
Traceback (most recent call last):
    ...
pans.runtime.errors.UsageError: none.pansrec: cannot be read: No such file or directory
  remedy: check the path and its permissions
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .any_recorder import AnyRecorder
    from .parted_recorder import PartedRecorder
    from .recorder import Recorder
    from .recording import Recording, read_recording
    from .replaying import replay

__all__ = ["AnyRecorder", "PartedRecorder", "Recorder", "Recording", "read_recording", "replay"]

__getattr__ = lazy_names(
    __name__,
    {
        "AnyRecorder": ".any_recorder",
        "PartedRecorder": ".parted_recorder",
        "Recorder": ".recorder",
        "Recording": ".recording",
        "read_recording": ".recording",
        "replay": ".replaying",
    },
)
