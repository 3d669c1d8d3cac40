"""The state of a core: one record that Python and the kernels go on from, each where the other has left it.

Kernels write it while they run. Python reads single fields at any time, by the properties of `Follower`, `StreamTracker` and
`DecisionWindows`, and writes only while no kernel runs.
"""

from __future__ import annotations

from pans.protocol.tracker import STREAM_FIELDS, state_dtype

# Ticks and exposure numbers beyond are left to Python's integers (protocol/wire/schema.py): the state holds the largest in their place.
LARGEST = (1 << 62) - 1
CORE_FIELDS = (
    *STREAM_FIELDS,
    "n_rows",  # decisions of this call
    "session",
    "visit",  # the object under way, its next window to be settled, and its number: still/windows.py
    "next_window",
    "object_index",
    "n_decisions",
    "n_abstained",
    "last_tick",  # end of the last exposure that came
    "jitter_ticks",  # most that a block's end differed from the plan
    "start_tick",
    "end_exposure",  # behind the last of the plan
    "exposure_ticks",  # from here on the plan, which nobody changes
    "period_ticks",
    "cycle_ticks",
    "visit_exposures",
    "shots",
    "n_classes",
    # Of a flow alone. Every core has one type of state: the compiler would take a record with more fields for one with fewer.
    "max_block",  # most frames of a block
    "dark_every",  # frames of a cycle that ends with a dark one; 0: none does
    "watch_at",  # from how many empty frames on they are told
    "frames",  # of a decision
    "objects",  # so far, modulo 2^32
    "told",  # how often the empty field was told
    "marked",  # above all numbers that have been marked
    "asks",  # whether a pulse is asked for
    "middle",  # of a tape's next window in whole exposures, and 2^-Q of one
    "middle_part",
    "pitch",
    "nominal_pitch",  # by the settings
    "track",  # how fast the tape is followed
    "before",  # the window before, -1: not known, and its middle
    "before_middle",
    "before_part",
    "position",
)
CORE_DTYPE = state_dtype(CORE_FIELDS)
