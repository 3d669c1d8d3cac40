"""The machine below Python: compiled kernels and real-time privileges.

jit.py has the decorators of kernels and their cache, jit_bytes.py bytes in kernels, realtime.py the priority of a process.
"""

from typing import TYPE_CHECKING

from pans.base import loaded_later

from .realtime import (
    FIFO_PRIORITY,
    GRANTED,
    ThreadCounts,
    apart,
    arm_realtime,
    bound,
    busy_core,
    check_core,
    cores_of,
    deciding_core,
    fault_words,
    first_line,
    give_way,
    held_heap,
    isolated_cores,
    lacking,
    load_average,
    locked_memory,
    off_the_deciding_core,
    scheduled,
    shallow_idle,
    steal_ms,
    usable_cores,
)

if TYPE_CHECKING:
    from .jit import FOLDER, inner, kernel_folder, njit, outer
    from .jit_bytes import as_float32, bare, copy_span, fence, load2, load4, load8, spin

__all__ = [
    "FIFO_PRIORITY",
    "FOLDER",
    "GRANTED",
    "ThreadCounts",
    "apart",
    "arm_realtime",
    "as_float32",
    "bare",
    "bound",
    "busy_core",
    "check_core",
    "copy_span",
    "cores_of",
    "deciding_core",
    "fault_words",
    "fence",
    "first_line",
    "give_way",
    "held_heap",
    "inner",
    "isolated_cores",
    "kernel_folder",
    "lacking",
    "load2",
    "load4",
    "load8",
    "load_average",
    "locked_memory",
    "njit",
    "off_the_deciding_core",
    "outer",
    "scheduled",
    "shallow_idle",
    "spin",
    "steal_ms",
    "usable_cores",
]

__getattr__ = loaded_later(__name__, "jit", "jit_bytes")
