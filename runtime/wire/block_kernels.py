"""What compiled walks ask of a decoded FRAMES message: its shape, and whether it is the next one of the stream.

Owns the offsets of the block's header (docs/reference/protocol.md) for kernels; never allocates and keeps no state.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .kernels import load4, load8
from .schema import BLOCK_HEADER_BYTES, HEADER, STRUCTS

BODY_HEADER, BLOCK_HEADER, MARK_BYTES = HEADER.size, BLOCK_HEADER_BYTES, STRUCTS["MARK"].size
LARGEST = np.uint64(1 << 62)  # ticks and exposure numbers beyond are left to Python's integers
_U = np.uint64


@njit(cache=True, nogil=True)
def block_shape(buffer, payload, stop):  # type: ignore[no-untyped-def]
    """Frames and bytes per frame of the FRAMES payload from `payload` to `stop`; (0, 0) when it is not as long as that."""
    if stop - payload <= _U(BLOCK_HEADER):
        return 0, 0
    shape = load4(buffer, payload + _U(28))
    count, width = np.int64(shape & _U(0xFFFF)), np.int64(shape >> _U(16))
    if np.int64(stop - payload) != BLOCK_HEADER + count * width:
        return 0, 0
    return count, width


@njit(cache=True, nogil=True)
def is_next(buffer, payload, count, next_seq, drops, next_exposure, end_exposure):  # type: ignore[no-untyped-def]
    """Whether a block of `count` frames follows without loss and lies within the plan."""
    return (
        load4(buffer, payload) == _U(next_seq)
        and load4(buffer, payload + _U(4)) == _U(drops)
        and load8(buffer, payload + _U(8)) < LARGEST
        and load8(buffer, payload + _U(16)) == _U(next_exposure)
        and next_exposure + count <= end_exposure
    )


@njit(cache=True, nogil=True)
def block_times(buffer, payload):  # type: ignore[no-untyped-def]
    """The tick at which a block's first exposure began, and the ticks from one to the next; int64."""
    return np.int64(load8(buffer, payload + _U(8))), np.int64(load4(buffer, payload + _U(24)))


@njit(cache=True, nogil=True)
def mark_photons(buffer, payload, photons, place):  # type: ignore[no-untyped-def]
    """Put a MARK's photons into `photons` float32 at `place`, bit for bit."""
    photons[place : place + 1].view(np.uint32)[0] = np.uint32(load4(buffer, payload + _U(28)))


@njit(cache=True, nogil=True)
def mark_truth(buffer, payload):  # type: ignore[no-untyped-def]
    """A MARK's truth, int64; -1: unknown."""
    return np.int64(np.int16(np.uint16(load4(buffer, payload + _U(8)) & _U(0xFFFF))))
