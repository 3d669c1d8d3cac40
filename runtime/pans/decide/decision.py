"""What a core gives: decisions with their flags, passages and pulses, the output of one step, and the rows of the decision log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, NamedTuple, Protocol, overload

import numpy as np
import numpy.typing as npt

from pans.bundle.backends import NO_LABEL as NO_LABEL


class DecisionFlag(IntFlag):
    """Why a decision is not to be trusted; lateness is a host's matter and stands in TIMINGS and EVENTS, not here."""

    GAP = 1  # exposures of the window never arrived
    WRONG_PATTERN = 2  # the device stamped another pattern than planned
    INCOMPLETE = 4  # the run ended within the window
    ABSTAINED = 8  # no label was given: label is 0xFFFF
    DARK_ALARM = 16  # the dark counts had changed when the window was measured
    STALE = 32  # the clicks were older than the decision may be
    NOT_FINITE = 64  # the back end gave no finite score
    COINCIDENCE = 128  # two objects passed at once: too long, or two maxima
    AMBIGUOUS = 256  # no class was sure enough


DECISION_DTYPE = np.dtype(
    [
        ("index", "<u8"),
        ("tick", "<u8"),  # end of the last exposure, device ticks
        ("exposure_index", "<u8"),  # the last exposure
        ("object", "<u4"),
        ("shot", "<u4"),  # the first shot of the window within the object's visit
        ("clicks", "<u4"),
        ("label", "<u2"),  # 0xFFFF: abstained
        ("truth", "<i2"),  # -1: unknown
        ("flags", "<u4"),  # DecisionFlag
        ("probability", "<f4"),  # softmax of the winner
        ("counts_crc", "<u4"),  # CRC-32 of the clicks per pattern (of a walk: per slot) as int64 little-endian
        ("exposures", "<u4"),  # of the walk; 0 where the patterns are fixed, and every decision takes the same
    ]
)

VERDICT_FIELDS = ("clicks", "label", "flags", "probability", "counts_crc")
VERDICT_DTYPE = np.dtype([(name, DECISION_DTYPE[name]) for name in VERDICT_FIELDS])
RUN_DTYPE = np.dtype(
    [
        ("index", "<u8"),  # of the first decision; the following ones count up
        ("tick", "<u8"),
        ("exposure_index", "<u8"),
        ("object", "<u4"),
        ("shot", "<u4"),
        ("count", "<u4"),  # decisions, 1 or more
        ("tick_step", "<u4"),
        ("exposure_step", "<u4"),
        ("shot_step", "<u4"),
        ("truth", "<i2"),
        ("continues", "<u2"),  # 1: the rest of the last run of the block before; of a core's runs 0
    ]
)


class Decision(NamedTuple):
    """One row of the decision log, in the order of DECISION_DTYPE; `probability` is the winning class's softmax.

    `exposures` are those with light of an automaton's walk, 0 where the patterns are fixed.
    """

    number: int
    tick: int
    exposure_index: int
    object: int
    shot: int
    clicks: int
    label: int
    truth: int
    flags: int
    probability: float
    counts_crc: int
    exposures: int = 0


class RowDecisions(Sequence[Decision]):
    """Decisions that stand in rows, DECISION_DTYPE (n,), valid until the next call, of which each is made when somebody asks for it."""

    def __init__(self, rows: npt.NDArray[np.void]) -> None:
        self.rows = rows

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Decision]:
        return iter([Decision(*row) for row in self.rows.tolist()])

    @overload
    def __getitem__(self, at: int) -> Decision: ...

    @overload
    def __getitem__(self, at: slice) -> list[Decision]: ...

    def __getitem__(self, at: int | slice) -> Decision | list[Decision]:
        found = self.rows[at].tolist()
        return [Decision(*row) for row in found] if isinstance(at, slice) else Decision(*found)


def rows_of(decisions: Sequence[Decision]) -> npt.NDArray[np.void]:
    """Return decisions as DECISION_DTYPE (n,); valid as long as they are."""
    return decisions.rows if isinstance(decisions, RowDecisions) else np.array(decisions, DECISION_DTYPE)


def is_decided(rows: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Return which of the decisions, DECISION_DTYPE (n,), have a label: did not abstain."""
    decided: npt.NDArray[np.bool_] = rows["label"] != NO_LABEL
    return decided & (rows["flags"] & int(DecisionFlag.ABSTAINED) == 0)


def is_judged(rows: npt.NDArray[np.void], n_classes: int = NO_LABEL) -> npt.NDArray[np.bool_]:
    """Return which of the decisions have a label and a known true class."""
    return is_decided(rows) & (rows["truth"] >= 0) & (rows["truth"] < n_classes)


class Action(NamedTuple):
    """A pulse that decision `number` asks for: output `channel` from `tick` on; worthless after `tick`. Absolute device ticks.

    The deadline of the decision counts from `end_tick`, the end of its last exposure.
    """

    number: int
    end_tick: int
    tick: int
    duration_ticks: int
    channel: int


class Passage(NamedTuple):
    """An object that has passed by, one per decision: exposures `first`..`last` with its light, the end of the last in device ticks.

    `centre` is the exposure at which it was centred, `clicks` are those of the whole passage.
    """

    first: int
    last: int
    centre: int
    leave_tick: int
    clicks: int


@dataclass(frozen=True, slots=True)
class BeyondPlan:
    """A block that lies beyond the plan or does not fit it: it was left out."""

    exposure_index: int

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording."""
        return {"kind": "beyond_plan", "exposure_index": self.exposure_index}


@dataclass(frozen=True, slots=True)
class StreamEndUnknown:
    """The stream ended and the device did not say how much it had exposed: `first_exposure` is the first that may be missing."""

    first_exposure: int

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording."""
        return {"kind": "stream_end_unknown", "first_exposure": self.first_exposure}


class CoreEvent(Protocol):
    """What a core tells beside its decisions: a `Gap`, a `Finding` of the dark counts, and the two above."""

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording: its `kind` and its facts."""


class Output(NamedTuple):
    """What one step produced; `block_end_tick` is the end of the last exposure seen, None if the frame held no exposures.

    In flow `passages` says, for every decision in its place, what it was made from; `actions` is what is to be done.
    """

    decisions: Sequence[Decision]
    events: Sequence[CoreEvent]
    block_end_tick: int | None
    passages: tuple[Passage, ...] = ()
    actions: tuple[Action, ...] = ()


def joined(first: Output, then: Output, block_end_tick: int | None = None) -> Output:
    """Return what two outputs say together, in their order."""
    return Output(
        [*first.decisions, *then.decisions],
        [*first.events, *then.events],
        block_end_tick,
        first.passages + then.passages,
        first.actions + then.actions,
    )
