"""What one sees while a run lives: figures in the terminal and as a web page, drawn by a process of its own.

Owns the pictures of a run that are taken beside the loop, their history over hours, and how both are shown. A thread takes a picture a few
times per second and hands it to a child process, which draws: the loop waits for neither. It never computes what a summary says (report),
and never changes a run.
"""

from .history import History
from .monitor import Monitor
from .snapshot import Snapshots

__all__ = ["History", "Monitor", "Snapshots"]
