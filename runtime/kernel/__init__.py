"""The compiled turn: from bytes in the system's buffer to decisions, the next command and what is to be recorded, in one call.

Owns the kernels that wait, read, decide and answer by themselves, and their memory; what is not ordinary they leave to Python's turn
(live/run.py), whose decisions they give bit for bit. live/compiled.py uses it.
"""

from .calls import Kernel, StreamCore

__all__ = ["Kernel", "StreamCore"]
