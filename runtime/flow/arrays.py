"""What the compiled steps of a flow work on, as tuples of arrays: the ring of frames, marks, all of a walk through a stream.

Owns the shapes alone; walk.py and deciding.py fill and read them, `FlowCore` (core.py) and `FlowSteps` (steps.py) allocate them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pans.runtime.core.stream_arrays import DecisionTables


class FlowArrays(NamedTuple):
    """The ring and what follows it, see kernels.py; `limits` is empty where no passages are looked for. `out` are the passages."""

    words: npt.NDArray[np.uint64]
    counts: npt.NDArray[np.int16]
    limits: npt.NDArray[np.int64]
    state: npt.NDArray[np.int64]
    dark_channels: npt.NDArray[np.int64]
    empty_channels: npt.NDArray[np.int64]
    out: npt.NDArray[np.int64]


class NewMarks(NamedTuple):
    """Marks that a call has met: int64 (m, N_MARK), and their photons, float32 (m,)."""

    rows: npt.NDArray[np.int64]
    photons: npt.NDArray[np.float32]


class FlowWalk(NamedTuple):
    """What deciding.py continues: the stream's place and the settings, int64 (walk.N_FACTS,), the ring, and what comes of each object.

    `offsets` int64 (slots of a cycle,) in ticks; `mask` uint64 (1,) of the channels; `sure` float64 (1,): below it a posterior is
    ambiguous; `gated` uint8 (classes,): of which a pulse is asked. Decisions stand in `rows`, DECISION_DTYPE (m,), in the same place
    their passages int64 (m, 5), in the order of `core.decision.Passage`, and the clicks of their windows int64 (m, d_f). What the empty
    field gave stands in `empty` int64 (k, 2 + d_f), by its number modulo k: the exposure behind the block, empty frames, clicks of
    each channel, since the run began. `heard` is StreamTracker's.
    """

    state: npt.NDArray[np.int64]
    flow: FlowArrays
    offsets: npt.NDArray[np.int64]
    mask: npt.NDArray[np.uint64]
    tables: DecisionTables
    sure: npt.NDArray[np.float64]
    gated: npt.NDArray[np.uint8]
    rows: npt.NDArray[np.void]
    passages: npt.NDArray[np.int64]
    counts: npt.NDArray[np.int64]
    empty: npt.NDArray[np.int64]
    edges: npt.NDArray[np.int64]
    heard: npt.NDArray[np.int64]
