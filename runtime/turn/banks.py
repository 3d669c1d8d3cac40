"""The banks of a call that goes on: equal parts of every ring, one of which is filled while another thread takes those before it.

Owns where a bank begins and ends, and when it changes hands; kernels.py fills it, lasting.py takes it. What stands in a bank is valid from
the moment `rings.HEAD` has passed it until `rings.TAIL` does. Never allocates.
"""

from __future__ import annotations

import numpy as np

from pans.runtime.core import stream_kernels as core
from pans.runtime.wire import walk as stream
from pans.runtime.wire.inner import inner

from . import rings as ring
from .shared import load, store

PUBLISH_EVERY_NS = 10_000_000
LOOK_EVERY_NS = 10_000_000  # the longest wait: whether to stop, and a sign of life
_BANKS, _STEPS, _ROOM_STEPS = ring.N_BANKS, ring.N_STEPS, ring.ROOM_STEPS


@inner
def enter_bank(walk, rings, control, bank, banks):  # type: ignore[no-untyped-def]
    """Go on at the beginning of `bank` of `banks`: nothing stands in it yet."""
    sizes = (
        rings.steps.shape[0],
        rings.messages.shape[0],
        rings.answers.shape[0],
        rings.shows.shape[0],
        rings.notes.shape[0],
        rings.arrivals.size,
        rings.kept.size,
    )
    for place in range(7):
        size = sizes[place] // banks
        control[_STEPS + place] = bank * size
        control[_ROOM_STEPS + place] = (bank + 1) * size
    size = walk.rows.size // banks
    control[ring.FROM_ROWS], control[ring.ROOM_ROWS] = bank * size, (bank + 1) * size
    control[ring.FROM_KEPT], control[ring.FROM_NOTES] = control[ring.KEPT], control[ring.N_NOTES]
    walk.state[core.N_ROWS] = bank * size


@inner
def publish(walk, rings, control, now):  # type: ignore[no-untyped-def]
    """Hand the bank under way over and go on in the next one; False, and nothing done, while that one has not been taken."""
    head = control[ring.HEAD]
    if head - load(control, ring.TAIL) >= _BANKS - 1:
        return False
    bank = head % _BANKS
    for column in range(ring.N_CONTROL):
        rings.heads[bank, column] = control[column]
    for column in range(walk.state.size):
        rings.states[bank, column] = walk.state[column]
    walk.state[stream.MESSAGES], walk.state[stream.EXPOSURES] = 0, 0
    store(control, ring.HEAD, head + 1)
    enter_bank(walk, rings, control, (head + 1) % _BANKS, np.int64(_BANKS))
    control[ring.PUBLISH_NS] = now + PUBLISH_EVERY_NS
    return True


@inner
def is_used(control):  # type: ignore[no-untyped-def]
    """Whether anything stands in the bank under way."""
    return control[ring.KEPT] > control[ring.FROM_KEPT] or control[ring.N_NOTES] > control[ring.FROM_NOTES]
