"""What a run needs of a recorder, whether it writes one file or parts.

Owns the interface alone; recorder.py and parted_recorder.py implement it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from pans.runtime.core.decision import NumberedDecisions
from pans.runtime.wire.frame import Messages

from .format import Kind


class AnyRecorder(Protocol):
    """A recording that is being written: adding buffers, `flush` writes, `close` ends it and returns the hash of its decisions."""

    path: Path
    watch_write: Callable[[int, int], None] | None

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: Any) -> None: ...

    def add_message(self, host_ns: int, data: bytes | bytearray | memoryview) -> None: ...

    def add_messages(self, host_ns: int, messages: Messages, first: int, count: int) -> None: ...

    def add_stamped(self, kind: Kind, data: NDArray[np.uint8], spans: NDArray[np.int64]) -> None: ...

    def add_command(self, host_ns: int, data: bytes | bytearray | memoryview) -> None: ...

    def add_answer(self, host_ns: int, data: bytes | bytearray | memoryview) -> None: ...

    def add_decision(self, record: Sequence[Any]) -> None: ...

    def prepare(self, decisions: NumberedDecisions) -> None: ...

    def add_decisions(self, many: NDArray[np.void] | NumberedDecisions) -> None: ...

    def add_timing_runs(self, runs: NDArray[np.void]) -> None: ...

    def add_timing(self, record: Sequence[Any]) -> None: ...

    def add_event(self, event: Mapping[str, Any]) -> None: ...

    def add_clock(self, samples: NDArray[np.void]) -> None: ...

    def flush_decisions(self) -> None: ...

    def flush(self) -> None: ...

    @property
    def n_written(self) -> int: ...

    @property
    def is_deleted(self) -> bool: ...

    def keep_deleted(self) -> Path | None: ...

    def close(self, summary: Mapping[str, Any]) -> str: ...
