"""What comes out of a live run, and what a run needs of its receiver. What goes in is run_options.py."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pans.runtime.core.decision import Output
    from pans.runtime.instrument.channel_health import DarkReport
    from pans.runtime.timing.ledger import TimingLedger

    from .tally import RunTally


@dataclass(slots=True)
class RunResult:
    """Everything a report needs; figures are measured, none is inferred from the configuration."""

    tally: RunTally
    timing: TimingLedger
    dark: DarkReport
    stream: dict[str, int]
    decoder: dict[str, int]
    clock: dict[str, Any]
    realtime: dict[str, Any]
    device: dict[str, Any]
    slot_jitter_us: float
    wrong_patterns: int  # late slots among them
    armed_after_s: float
    seconds: float
    ended: str
    link_lost: bool
    reconnects: int = 0
    late_cause: dict[str, int] = field(default_factory=dict)  # late decisions by who is to blame (blame.CAUSES)
    lost_cause: dict[str, int] = field(default_factory=dict)  # lost exposures
    contradictions: dict[str, int] = field(
        default_factory=dict
    )  # messages that the evidence excludes, by what is wrong
    late_slots: int = 0  # that stayed dark because the host named no state in time
    turn_us: dict[str, float] = field(default_factory=dict)  # of the host's turns, where it drives
    states_shown: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # exposures of each state
    decisions_sha256: str = ""
    events: list[dict[str, Any]] = field(default_factory=list)
    page_faults: dict[str, int] = field(default_factory=dict)  # of the loop's thread while armed; its switches too


class Receives(Protocol):
    """What a live run needs of its receiver (receiver.Receiver)."""

    def prepare(self) -> None: ...

    def receive(self, poll_s: float) -> list[Output]: ...

    def last(self, poll_s: float) -> None: ...

    def rest(self) -> None: ...

    def next_id(self) -> int: ...
