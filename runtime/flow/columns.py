"""The columns of what the compiled steps of a flow continue: where its stream stands, its settings, and what came.

Owns their order alone; it begins with a core's, so that the compiled turn reads both alike.
"""

from pans.runtime.core import stream_kernels as core

# facts, int64 (N_FACTS,): the columns of a core's state, as far as a flow has them (where the stream stands, what a block must be like
# and when it should end, when the last one ended), ...
START_TICK, EXPOSURE_TICKS, PERIOD_TICKS, CYCLE_TICKS = (
    core.START_TICK,
    core.EXPOSURE_TICKS,
    core.PERIOD_TICKS,
    core.CYCLE_TICKS,
)
N_CLASSES, END_TICK, JITTER_TICKS = core.N_CLASSES, core.LAST_TICK, core.JITTER
# ... the same of a flow alone, and from how many empty frames on they are told, ...
MAX_BLOCK, DARK_CYCLE, WATCH_AT = range(core.N_STATE, core.N_STATE + 3)
# ... what came of a call of `walk`, ...
MARKS, PASSAGES = range(WATCH_AT + 1, WATCH_AT + 3)
# ... and of deciding.py: the frames of a decision, objects so far, how often the empty field was told, whether a pulse is asked for; ...
FRAMES, OBJECTS, TOLD, ASKS = range(PASSAGES + 1, PASSAGES + 5)
# ... of a tape: the middle of the next window in whole exposures and 2^-32 of one, the pitch and what it is by the settings, and how
# fast it is followed; the window before (-1: not known) and its middle
MIDDLE, MIDDLE_PART, PITCH, NOMINAL_PITCH, TRACK, BEFORE, BEFORE_MIDDLE, BEFORE_PART, POSITION, N_FACTS = range(
    ASKS + 1, ASKS + 11
)
