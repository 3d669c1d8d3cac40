"""Kernels that kernels alone call, made ready to be compared with their oracles."""

from typing import Any

from numba import njit


def called(kernel: Any) -> Any:
    """Return an inner kernel (base/machine/jit.py) with a way in from Python."""
    return njit(nogil=True)(kernel.py_func) if hasattr(kernel, "py_func") else kernel
