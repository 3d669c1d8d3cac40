"""What goes into a live run and what comes out of it, as plain facts.

Owns no behaviour; units are in the names. Light to import: the command line fills these in before anything is loaded.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pans.runtime.instrument.calibration import MAX_AGE_H

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pans.runtime.instrument.channel_health import DarkReport
    from pans.runtime.timing.ledger import TimingLedger

    from .tally import RunTally


AUTO, COMPILED, PYTHON = "auto", "compiled", "python"
TURNS = (AUTO, COMPILED, PYTHON)


class TurnChoice(NamedTuple):
    """Which turn a run took, COMPILED or PYTHON, and why, "" where nothing was in the way of the compiled one."""

    taken: str = PYTHON
    why: str = ""

    def words(self) -> str:
        """Return it as it stands in a summary."""
        return f"{self.taken}: {self.why}" if self.why else self.taken


@dataclass(frozen=True, slots=True)
class RunConfig:
    """What to run: `shots` per decision, how many cycles (0: until `seconds` have passed or the device stops).

    `started_ns` is the time from which "armed after" counts, on time.perf_counter_ns (0: from the call of run_live).
    """

    shots: int = 1
    n_cycles: int = 0
    seconds: float = 0.0
    deadline_us: float = 0.0
    lease_ms: int = 1000
    realtime: bool = True
    started_ns: int = 0
    core: int | None = None  # that the loop is bound to, and kept awake
    turn: str = AUTO  # one of TURNS


@dataclass(frozen=True, slots=True)
class DarkSettings:
    """What to do about calibration and dark counts; `policy` is one of dark_guard.POLICIES."""

    calibration: Path | None = None
    max_age_h: float = MAX_AGE_H
    policy: str = "warn"
    warns: bool = False  # about a calibration that is missing or old
    registration: Path | None = None  # of the optical table; its age is checked like a calibration's


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
    turn: TurnChoice = field(default_factory=TurnChoice)
    decisions_sha256: str = ""
    events: list[dict[str, Any]] = field(default_factory=list)
    page_faults: dict[str, int] = field(default_factory=dict)  # of the loop's thread while armed; its switches too
