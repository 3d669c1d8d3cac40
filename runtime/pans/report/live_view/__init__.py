"""The live view of a run, in the terminal and as a web page, drawn by a process of its own.

A thread takes a snapshot of the run a few times per second and passes it to a child process, which draws; the loop waits for neither.
Start at monitor.py, then snapshot.py.
"""

from .history import History
from .monitor import Monitor, load_drawing

__all__ = ["History", "Monitor", "load_drawing"]
