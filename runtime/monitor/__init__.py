"""The live view of a run: figures in the terminal and as a web page, drawn by a process of its own.

A thread takes a snapshot of the run a few times per second and hands it to a child process, which draws: the loop waits for neither. The
summary at the end is the package report's. Start with monitor.py, then snapshot.py.
"""

from .history import History
from .monitor import Monitor

__all__ = ["History", "Monitor"]
