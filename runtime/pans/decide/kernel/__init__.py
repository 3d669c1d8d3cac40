"""The compiled loop: from bytes in the system's buffer to decisions and the next command, in one call.

In: a descriptor or bytes, and the state of a core. Out: rows of decisions, times of blocks, messages and commands as they were. Irregular
messages are left to Python. Start at calls.py (`Kernel`), then receive.py; arrays.py says what each array and column means.
"""

from . import arrays as arrays
from .arrays import OVERSLEPT_NS, Drive
from .calls import BATCH_NS, Kernel, Limits
from .follow_up import NO_ENDS, Ends, FollowUp, follow_up_of
from .follow_up import PhotonsOf as PhotonsOf
from .receive import QUIET_NS, turn, unpack_blocks
from .stream_core import StreamCore
from .system_calls import now_ns, offered, read_now, wait_for, write_now

__all__ = [
    "BATCH_NS",
    "NO_ENDS",
    "OVERSLEPT_NS",
    "QUIET_NS",
    "Drive",
    "Ends",
    "FollowUp",
    "Kernel",
    "Limits",
    "StreamCore",
    "arrays",
    "follow_up_of",
    "now_ns",
    "offered",
    "read_now",
    "turn",
    "unpack_blocks",
    "wait_for",
    "write_now",
]
