"""What a live run needs of a core: the calls that core.Core and flow.FlowCore have in common; and of what takes its turns.

Owns the interface alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from pans.runtime.core.decision import Output
from pans.runtime.core.follower import Place
from pans.runtime.turn import Turn
from pans.runtime.wire.frame import Messages
from pans.runtime.wire.messages import Frame, Mark
from pans.runtime.wire.tracker import StreamTracker


class LiveCore(Protocol):
    """What a live run needs of a core (core.Core is one): stream frames in, outputs out, deterministic, no clock.

    `tracker` accounts for the stream, `marks` are the objects' marks by number, `tallies` int64 (window.N_TALLIES,) the dark
    exposures, dark clicks and wrong patterns, in that order.
    """

    start_tick: int
    completed: bool
    n_decisions: int
    jitter_ticks: int
    tracker: StreamTracker
    contradictions: Counter[str]

    @property
    def marks(self) -> Mapping[int, Mark]: ...

    @property
    def tallies(self) -> npt.NDArray[np.int64]: ...

    def warm_up(self) -> None: ...

    def begin(self, start_tick: int, n_cycles: int) -> Output: ...

    def step(self, frame: Frame) -> Output: ...

    def step_messages(self, messages: Messages, place: int) -> tuple[int, Output]: ...

    def end(self) -> Output: ...

    def cycles_left(self, n_cycles: int) -> int: ...

    def part(self) -> Place | None: ...


class Turns(Protocol):
    """What takes a live run's turns in the place of Python's (compiled.CompiledTurns, lasting.LastingTurns).

    `prepare` once a connection is there, `attach` before each ARM; `turn` waits, decides and answers, and returns what came of it.
    `settled` is told after each call that brought messages. Where the turns go on in another thread (`goes_on`), core, session and
    driver are behind them; `halt` ends that, and all are where the turns have come. `lives`: whether they do. `leave_off` ends it from
    any thread and returns the id of the next command, 0: the session knows it. `close` once, at the end.
    """

    settled: Callable[[Turn, Output], None] | None

    @property
    def goes_on(self) -> bool: ...

    @property
    def lives(self) -> bool: ...

    @property
    def page_faults(self) -> dict[str, int]: ...

    def prepare(self) -> None: ...

    def attach(self) -> None: ...

    def turn(self, poll_s: float) -> list[Output]: ...

    def halt(self) -> None: ...

    def leave_off(self) -> int: ...

    def close(self) -> None: ...
