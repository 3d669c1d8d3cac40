"""The kernel of the live loop: from bytes in the system's buffer to decisions, the next command and what is to be recorded, in one call.

In come a descriptor, or bytes that were read elsewhere, and the state of a core; out come rows of decisions, the times of blocks, messages
as they came and commands as they left. What is not ordinary it leaves to Python. Start with calls.py (`Kernel`), then receive.py; state.py
says what each array and column means.
"""

from .calls import Kernel, StreamCore

__all__ = ["Kernel", "StreamCore"]
