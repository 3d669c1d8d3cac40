"""What a recorder holds back: rows and bytes in memory allocated beforehand, emptied into blocks.

Owns the memory; never touches a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .format import Kind

BUFFER_ROWS = 4096


class RowBuffer:
    """A preallocated table of `BUFFER_ROWS` rows that is emptied into a block."""

    def __init__(self, kind: Kind, dtype: np.dtype[np.void]) -> None:
        self.kind = kind
        self.rows = np.full(BUFFER_ROWS, 0, dtype=dtype)  # touched, which np.zeros leaves to the first use
        self.used = 0

    def room(self) -> int:
        return len(self.rows) - self.used

    def add(self, row: Sequence[Any]) -> bool:
        """Store one row; True when the table is full."""
        self.rows[self.used] = row
        self.used += 1
        return not self.room()

    def add_many(self, rows: np.ndarray[Any, np.dtype[np.void]]) -> int:
        """Store as many rows as there is room for; return how many."""
        n = min(len(rows), self.room())
        self.rows[self.used : self.used + n] = rows[:n]
        self.used += n
        return n

    def take(self) -> bytes:
        data = self.rows[: self.used].tobytes()
        self.used = 0
        return data


class ByteBuffer:
    """A preallocated byte buffer that is emptied into a block."""

    def __init__(self, kind: Kind, size: int) -> None:
        self.kind = kind
        self.data = bytearray(size)
        self.array = np.frombuffer(self.data, np.uint8)  # the same bytes
        self.array[:] = 0  # touched
        self.used = 0

    def room(self) -> int:
        return len(self.data) - self.used

    def add(self, piece: bytes | bytearray | memoryview) -> None:
        self.data[self.used : self.used + len(piece)] = piece
        self.used += len(piece)

    def take(self) -> bytes:
        data = bytes(memoryview(self.data)[: self.used])
        self.used = 0
        return data
