"""The arrays of the kernel: what goes into a call, what both ends keep, and the rings that a call fills."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

OVERSLEPT_NS = 500_000  # a timer that fires later than this was not the timer's fault

U8 = npt.NDArray[np.uint8]
I64 = npt.NDArray[np.int64]

# control, int64 (N_CONTROL,). Set by the caller before a call: the descriptor, and whether it is read (0: only what is decoded already);
# until when; how long after a block the next one is overdue (0: do not watch); how long to poll awake at first; how many messages may
# come; whether a stream is open (2: STATUS is passed while the device measures, 3: EXPOSED, too); whether SHOW is sent, whether commands
# wait in the session; most rows of one block; waits that lie closer together are one
FD, READS, DUE_NS, PATIENCE_NS, EAGER_NS, BUDGET, OPEN, DRIVES, WAITING, BLOCK_ROWS, FLOOR_NS = range(11)
STOP = 11  # set by anybody, at any time: the call ends
# kept by both sides: the next decoded body and how many there are, when they were read, when a block came last; the session's
# window of commands (next id, the oldest without an answer, since when that counts); what SHOW named last
PLACE, N_BODIES, ARRIVAL_NS, BLOCK_NS, NEXT_ID, OLDEST_ID, OLDEST_NS, SENT_EXPOSURE, SENT_STATE = range(12, 21)
# of bytes that were read elsewhere: the next read, and where it begins
NEXT_READ, READ_AT = range(21, 23)
# the id of the first command that this call may send; whether the caller must know of a block at once
FIRST_ID, URGENT = range(23, 25)
# the part of the rings that is being filled: one of HALVES (1: all of it), and where it begins and ends, in entries, bytes and rows
HALVES, HALF, FIRST, LIMIT, KEPT_LIMIT, FIRST_ROW, ROW_LIMIT = range(25, 32)
# of a kernel that serves in a thread of its own. Set by the caller: whether it does; the pipes by which it is woken and wakes; how long
# blocks are gathered, and how many messages at most, before they are handed over. The caller asks it to park by PARK and lets it go on
# by clearing PARKED. READY: a batch has been handed over and is not accounted for yet; HUNGRY: the next one waits for that.
SERVES, WAKE_FD, TELL_FD, BATCH_NS, BATCH_MESSAGES, PARK, PARKED, READY, HUNGRY = range(32, 41)
# when it handed over last; the block after which it has reported the next one overdue, when, and whether Python is to see to it
HANDED_NS, OVERDUE_BLOCK_NS, OVERDUE_NS, OVERDUE = range(41, 45)
# of its sleep while no decision can fall due. Set by the caller: the length of a tick in ps (0: it never sleeps), and when a clock probe
# was sent last. Kept by the kernel: when a PONG came last, and of a tick at which an exposure ended, when its block comes at the earliest
TICK_PS, PROBED_NS, PONG_NS, PACE_TICK, PACE_NS = range(45, 50)
# what a call, or a batch, reports: errno, bytes of the last command that were not sent, when anything of the session came last, up to
# where each ring and the rows are used, the exposure that comes next, how often a flow has told of the empty field, and why it ended
ERRNO, UNSENT, HEARD_NS, N_STEPS, N_MESSAGES, N_ANSWERS, N_SHOWS, N_NOTES, N_ARRIVALS, KEPT = range(50, 60)
STOP_ROW, FOLLOWING, TOLD, ENDED, N_CONTROL = range(60, 65)

# steps, int64 (n, N_STEP): one for each block
ARRIVAL, DECODED, DECIDED, RECORDED, END_TICK, ROWS, MESSAGES, SHOWS, N_STEP = range(9)
# messages, answers and shows, int64 (n, 4): where a body (of `shows`: a frame) stands in `kept`, the time at which it came or left, and
# its type (of `shows`: the arrival that it answers; of `answers` DONE or REFUSAL where the kernel has accounted for it)
BEGIN, END, TIME, WHAT = range(4)
DONE, REFUSAL = -2, -1

ALL_TAKEN, DUE, FULL, ODD, GONE, SIGNALLED, BROKEN = range(7)  # why a call ended
WHY = ("all taken", "due", "full", "odd", "gone", "signalled", "broken")

KEPT_BYTES = 1 << 20
MANY = 4096  # messages of one call: no more objects than marks are remembered (still/kernels.MARK_SLOTS)
SHOW_BYTES = 64  # a SHOW command on the wire is shorter


class Rings(NamedTuple):
    """What a call fills: bytes as they came (bodies) and left (frames), uint8 (KEPT_BYTES,), and the rings of int64."""

    kept: U8
    steps: I64
    messages: I64
    answers: I64
    shows: I64
    notes: I64  # (n, 4): waits for bytes: began, asked until, ended
    arrivals: I64
    standings: I64  # (n, 4): of a STATUS or EXPOSED among `messages`, where the stream stood then (follower.Standing)
    handed: I64  # (N_CONTROL,): `control` as it was when a batch was handed over
    spare: U8  # what is read from and written to the pipes


class Decoder(NamedTuple):
    """The arrays of a wire.framing.FrameDecoder."""

    buffer: U8
    bodies: I64
    tally: I64


class Drive(NamedTuple):
    """What names the next state of a walk: by slot the steps before it, the slots of the steps, and the tails of SHOW by state.

    `plain` is a SHOW command without its COBS, header and opcode set; arrays of length 0 where the host does not drive. `sizes` int64
    (2,): slots of a cycle, walks of an object.
    """

    next_step: I64
    slot_of: I64
    tails: U8
    plain: U8
    sizes: I64


def make_rings() -> Rings:
    """Return rings; their memory is touched when the kernel is warmed up."""
    messages, answers, shows, notes, standings = (np.empty((MANY, 4), np.int64) for _ in range(5))
    steps, arrivals, handed = (
        np.empty((MANY, N_STEP), np.int64),
        np.empty(MANY, np.int64),
        np.empty(N_CONTROL, np.int64),
    )
    kept, spare = np.empty(KEPT_BYTES, np.uint8), np.empty(64, np.uint8)
    return Rings(kept, steps, messages, answers, shows, notes, arrivals, standings, handed, spare)


def no_drive() -> Drive:
    """Return the drive of a run that the host does not drive."""
    nothing: I64 = np.zeros(0, np.int64)
    return Drive(nothing, nothing, np.zeros((0, 0), np.uint8), np.zeros(0, np.uint8), np.ones(2, np.int64))
