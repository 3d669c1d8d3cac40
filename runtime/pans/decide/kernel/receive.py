"""The kernel's loop: wait, read, resynchronise, check, decide, name the next state, keep what came.

It continues by itself with all that is ordinary and leaves the rest, untouched and in its place, to the caller. Bytes are decoded by
protocol/wire/kernels.py, messages taken by the kernel of the core's kind (`Walk.kernel`: still/kernels.py, flow/kernels.py), commands
written by show.py. It never allocates.

In turn with its caller, a call ends when something is due or irregular. In a thread of its own (control[SERVES]) it never returns:
it hands over what has come in one half of the rings and fills the other half meanwhile, and parks for a message that Python must take.

    filling one half --(time, many, urgent; READY is 0)--> copy `control` to `handed`, READY = 1, wake Python --> filling the other half
    irregular message, PARK --> hand over, PARKED = 1 ------(Python clears PARKED, wakes the kernel)-----------> filling the other half

Python reads a batch only after it was woken, and clears READY when it has done with it; no half is written while Python reads it.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from pans.base.machine import bare, copy_span, fence, inner, load4, outer
from pans.decide.still import kernels as core
from pans.decide.still.kernels import WalkArrays
from pans.protocol.wire import MAX_FRAME_BYTES, SCHEMA, DeviceState, MessageType
from pans.protocol.wire import kernels as stream
from pans.protocol.wire import kernels as wire

from . import arrays as ring
from .arrays import OVERSLEPT_NS
from .show import IS_ODD, IS_REFUSED, send_show, take_ack
from .system_calls import AGAIN, INTERRUPTED, now_ns, read_now, wait_both, wait_for, write_now


@inner
def _answer_nothing(walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    return np.bool_(True)


def answering(kind: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the kernel that answers a block of a walk of class `kind`, and no names: it wants the whole walk."""
    return (send_show if kind is WalkArrays else _answer_nothing), ()


@inner
def _spare_nothing(walk):  # type: ignore[no-untyped-def]
    return np.int64(0)


def sparing(kind: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the kernel that says how long a walk of class `kind` brings no decision, and no names: it wants the whole walk."""
    return (core.ticks_to_spare if issubclass(kind, WalkArrays) else _spare_nothing), ()


def _typed(chosen: tuple[Any, tuple[str, ...]], context: Any, walk: Any, rest: tuple[Any, ...]) -> tuple[Any, Any]:
    """Return what the compiler wants of a call of a kernel that takes `rest` and then fields of the walk, or the walk and then `rest`.

    `chosen` is the kernel and the names of the fields; without names it takes the whole walk. The fields are taken out here: one more
    kernel in between takes the compiler half a second.
    """
    kernel, names = chosen
    places = [walk.fields.index(name) for name in names]
    arguments = (*rest, *(walk.types[place] for place in places)) if names else (walk, *rest)
    called = types.Dispatcher(kernel)
    found = context.resolve_function_type(called, arguments, {})

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        function = context.get_function(called, found)
        parts = [builder.extract_value(values[0], place) for place in places]
        result = function(builder, [*values[1:], *parts] if names else values)
        context.add_linking_libs(getattr(function, "libs", ()))
        return result

    return found.return_type(walk, *rest), code


if numba.config.DISABLE_JIT:

    def take_message(walk: Any, *rest: Any) -> Any:
        """Take a message with the kernel of the walk's kind."""
        kernel, names = type(walk).kernel()
        return kernel(*rest, *(getattr(walk, name) for name in names)) if names else kernel(walk, *rest)

    def answer(walk: Any, *rest: Any) -> Any:
        """Answer a block with the kernel of the walk's kind."""
        return answering(type(walk))[0](walk, *rest)

    def ticks_to_spare(walk: Any) -> Any:
        """Ask the kernel of the walk's kind how long no decision can fall due."""
        return sparing(type(walk))[0](walk)

else:

    @intrinsic
    def take_message(context, walk, buffer, start, stop):  # type: ignore[no-untyped-def]
        """Take the message from `start` to `stop`, uint64, of `buffer`: by the kernel of the walk's kind."""
        return _typed(walk.instance_class.kernel(), context, walk, (buffer, start, stop))

    @intrinsic
    def answer(context, walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
        """Answer a block that has been taken; False when that could not be sent whole."""
        return _typed(answering(walk.instance_class), context, walk, (drive, rings, control, scratch))

    @intrinsic
    def ticks_to_spare(context, walk):  # type: ignore[no-untyped-def]
        """Ticks from the latest exposure to the last one that brings no decision for sure; 0 where there is none."""
        return _typed(sparing(walk.instance_class), context, walk, ())


READ_BYTES = 1 << 16  # at once, as protocol/links/serial.py
LEAST_WAIT_NS = 200_000
QUIET_NS = 5_000_000
NAP_NS = 200_000_000  # longest wait of a serving kernel: a wake-up that was lost costs no more
# a device that is late all the time is asked so often: each probe costs both sides a wake-up
SILENCE_EVERY_NS = 100_000_000
# A sleep lasts two blocks at least, or it saves nothing, and at most half a terminal's buffer of 4096 bytes (a socket's is larger).
SLEEP_NS, SLEEP_BYTES, LEAST_SLEEP_BLOCKS = 2_000_000, 2048, 2
AWAKE_NS = 200_000  # before a decision can fall due: a timer fires 50 us late by itself, and waking takes as long
PONG_WAIT_NS = 250_000_000  # as long as live/session.py waits for a probe
LONGEST_TICKS = 1 << 30  # between two blocks: times TICK_PS that fits into 64 bits
HUNGRY_NS = 1_000_000  # how often it looks whether Python has done with the batch before
_ACK, _PONG = int(MessageType.ACK), int(MessageType.PONG)
_STATUS, _EXPOSED = int(MessageType.STATUS), int(MessageType.EXPOSED)
_ARMED, _RUNNING = int(DeviceState.ARMED), int(DeviceState.RUNNING)
_U = np.uint64
_LIMIT, _SCHEMA = np.int64(MAX_FRAME_BYTES), np.int64(SCHEMA)  # plain numbers are types of their own to the compiler


@outer
def turn(fed, reads, decoder, walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    """Process decoded messages, then read more until something is due or irregular; return the reason (arrays.WHY).

    decoder Decoder, walk of a class with a `kernel()`, drive Drive, rings Rings, control int64 (N_CONTROL,), scratch int64 (4,). Rings
    are filled from the beginning of their half. Where there are `reads`, nothing is read but `fed` uint8, read by read: `reads` int64
    (n, 2) are their bytes and the times of their arrival, control[NEXT_READ] and control[READ_AT] say which one comes next, and where
    it begins; ALL_TAKEN behind the last one. With control[SERVES] it returns when STOP is set, or where Python is to close the link.
    """
    decoder, walk, drive, rings = bare(decoder), bare(walk), bare(drive), bare(rings)
    fed, reads, control, scratch = bare(fed), bare(reads), bare(control), bare(scratch)
    while True:
        _begin(walk, control)
        control[ring.FIRST_ID] = control[ring.NEXT_ID]
        ended = _until_ended(fed, reads, decoder, walk, drive, rings, control, scratch)
        if not control[ring.SERVES]:
            _report(walk, control, ended)
            return ended
        if not _park(walk, rings, control, ended, scratch):
            return ended


@inner
def _until_ended(fed, reads, decoder, walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    # before the first read neither the clock nor the blocks are looked at
    began_ns, blocks = np.int64(-1), np.int64(-1)
    while True:
        ended = take_bodies(decoder, walk, drive, rings, control, scratch)
        if control[ring.SERVES]:
            if ended == ring.ALL_TAKEN:
                ended = _await_served(decoder, walk, rings, control, scratch)
            if ended == ring.FULL:  # Python is behind by a whole half: wait for it
                if not _make_free(walk, rings, control, scratch):
                    return ring.DUE
                continue
            if ended != ring.ALL_TAKEN:
                return ended
        elif ended == ring.ALL_TAKEN and reads.shape[0]:
            if control[ring.NEXT_READ] == reads.shape[0]:
                return ended
            if control[ring.N_ARRIVALS] == control[ring.LIMIT]:
                return ring.FULL
            _next_read(fed, reads, decoder, control)
        elif ended != ring.ALL_TAKEN or not control[ring.READS] or control[ring.URGENT]:
            return ended
        else:
            if began_ns < 0:
                began_ns = np.int64(now_ns(scratch))
            elif control[ring.N_STEPS] > blocks and now_ns(scratch) >= control[ring.DUE_NS]:
                return ring.DUE
            blocks = control[ring.N_STEPS]
            ended = _await_bytes(decoder, rings, control, began_ns, scratch)
            if ended != ring.ALL_TAKEN:
                return ended
        rings.arrivals[control[ring.N_ARRIVALS]] = control[ring.ARRIVAL_NS]
        control[ring.N_ARRIVALS] += 1


# -- serving in a thread -----------------------------------------------------------------------------------------------


@inner
def _await_served(decoder, walk, rings, control, scratch):  # type: ignore[no-untyped-def]
    """Read what comes, and hand over when it is time; ALL_TAKEN when new bytes are decoded, or why the kernel parks.

    Bytes are read as soon as they are there, but while no decision can fall due only after a sleep, many at once.
    """
    _keep_pace(walk, control)
    slept = False
    while True:
        if control[ring.STOP] or control[ring.PARK]:
            return ring.DUE
        if control[ring.N_ARRIVALS] == control[ring.LIMIT] or control[ring.N_NOTES] == control[ring.LIMIT]:
            return ring.FULL
        now = now_ns(scratch)
        due, gathered = now + NAP_NS, control[ring.N_MESSAGES] - control[ring.FIRST]
        patience = control[ring.PATIENCE_NS]
        # after a sleep the block that seems overdue may be there
        if patience and control[ring.OVERDUE_BLOCK_NS] != control[ring.BLOCK_NS] and not slept:
            at = max(control[ring.BLOCK_NS] + patience, control[ring.OVERDUE_NS] + SILENCE_EVERY_NS)
            if now >= at:  # Python asks the device, once in each silence
                control[ring.OVERDUE_BLOCK_NS], control[ring.OVERDUE_NS] = control[ring.BLOCK_NS], now
                control[ring.OVERDUE] = 1
                write_now(control[ring.TELL_FD], rings.spare, 0, 1)
            else:
                due = min(due, at)
        if control[ring.URGENT] or control[ring.N_ARRIVALS] > control[ring.FIRST]:
            at = control[ring.HANDED_NS] + control[ring.BATCH_NS]
            if control[ring.URGENT] or gathered >= control[ring.BATCH_MESSAGES] or now >= at:
                if not control[ring.READY]:
                    _hand_over(walk, rings, control, ring.DUE, scratch)
                    continue
                control[ring.HUNGRY], due = 1, min(due, now + HUNGRY_NS)
            else:
                due = min(due, at)
        sleep = np.int64(0) if slept else _sleep_ns(walk, rings, control, now, due)
        if sleep:
            slept = True
            _nap(rings, control, sleep, scratch)
            _note_wait(rings.notes, control, now, now + sleep, now_ns(scratch))
            continue
        if slept:
            slept, due = False, now
        ready = wait_both(control[ring.FD], control[ring.WAKE_FD], due - now, scratch)
        _note_wait(rings.notes, control, now, due, now_ns(scratch))
        if ready < 0 and ready != -INTERRUPTED:
            return _failed(control, ready)
        if ready >= 2:
            read_now(control[ring.WAKE_FD], rings.spare, 0, rings.spare.size)
        if ready == 1 or ready == 3:
            found = _read(decoder, control, scratch)
            if found > 0:
                return ring.ALL_TAKEN
            if found != -AGAIN and found != -INTERRUPTED:
                return _failed(control, found)


@inner
def _keep_pace(walk, control):  # type: ignore[no-untyped-def]
    """Note when the block of the latest exposure comes at the earliest: as the quickest before it, by the plan and the device's clock.

    A block that waited, here or on the way, changes nothing of that. Clocks may differ by one in 1024 (protocol/clock.MAX_RATE_ERROR).
    """
    ticks = walk.state[0].last_tick - control[ring.PACE_TICK]
    if ticks == 0 or not control[ring.TICK_PS]:
        return
    at = control[ring.ARRIVAL_NS]
    if control[ring.PACE_NS] and 0 < ticks < LONGEST_TICKS:
        passed = ticks * control[ring.TICK_PS] // 1000
        at = min(at, control[ring.PACE_NS] + passed + (passed >> 10))
    control[ring.PACE_TICK], control[ring.PACE_NS] = walk.state[0].last_tick, at


@inner
def _sleep_ns(walk, rings, control, now, due):  # type: ignore[no-untyped-def]
    """How long the kernel may sleep though blocks come: until the one before a decision, and not beyond `due`; 0: it stays awake.

    The arrival of a block that decides nothing is then known no better than to a sleep. That of a PONG measures the link.
    """
    n, ps = control[ring.N_STEPS], control[ring.TICK_PS]
    if not ps or not control[ring.OPEN] or control[ring.DRIVES] or control[ring.URGENT] or n - control[ring.FIRST] < 2:
        return np.int64(0)
    if control[ring.PROBED_NS] > control[ring.PONG_NS] and now - control[ring.PROBED_NS] < PONG_WAIT_NS:
        return np.int64(0)
    ticks = rings.steps[n - 1, ring.END_TICK] - rings.steps[n - 2, ring.END_TICK]
    if not 0 < ticks < LONGEST_TICKS:
        return np.int64(0)
    between = ticks * ps // 1000
    if LEAST_SLEEP_BLOCKS * between > SLEEP_NS:
        return np.int64(0)
    latest = rings.messages[control[ring.N_MESSAGES] - 1]
    blocks = SLEEP_BYTES // (latest[ring.END] - latest[ring.BEGIN])
    spare = min(ticks_to_spare(walk), blocks * ticks) * ps // 1000 - max(AWAKE_NS - between, 0)
    sleep = min(control[ring.PACE_NS] + spare, now + SLEEP_NS, due) - now
    return sleep if sleep >= LEAST_SLEEP_BLOCKS * between else np.int64(0)


@inner
def _make_free(walk, rings, control, scratch):  # type: ignore[no-untyped-def]
    """Wait until Python has done with the batch before, then hand over; False when the kernel is to stop."""
    while control[ring.READY]:
        control[ring.HUNGRY] = 1
        _nap(rings, control, HUNGRY_NS, scratch)
        if control[ring.STOP]:
            return False
    _hand_over(walk, rings, control, ring.FULL, scratch)
    return True


@inner
def _hand_over(walk, rings, control, ended, scratch):  # type: ignore[no-untyped-def]
    """Hand what has come to Python, which has done with the batch before, and go on in the other half."""
    control[ring.HANDED_NS], control[ring.HUNGRY] = now_ns(scratch), 0
    _report(walk, control, ended)
    for column in range(ring.N_CONTROL):
        rings.handed[column] = control[column]
    control[ring.HALF] = 1 - control[ring.HALF]
    _begin(walk, control)
    fence()  # the batch is whole before READY says so
    control[ring.READY] = 1
    fence()
    write_now(control[ring.TELL_FD], rings.spare, 0, 1)


@inner
def _park(walk, rings, control, ended, scratch):  # type: ignore[no-untyped-def]
    """Hand over and wait until Python lets the kernel go on; False when it is to stop."""
    while control[ring.READY]:
        control[ring.HUNGRY] = 1
        _nap(rings, control, HUNGRY_NS, scratch)
        if control[ring.STOP]:
            return False
    control[ring.PARKED] = 1
    _hand_over(walk, rings, control, ended, scratch)
    while control[ring.PARKED] and not control[ring.STOP]:
        _nap(rings, control, NAP_NS, scratch)
    fence()  # what Python has changed is read from here on
    return not control[ring.STOP]


@inner
def _nap(rings, control, wait_ns, scratch):  # type: ignore[no-untyped-def]
    """Wait for Python, at most `wait_ns`."""
    if wait_for(control[ring.WAKE_FD], np.int64(wait_ns), np.bool_(False), scratch) > 0:
        read_now(control[ring.WAKE_FD], rings.spare, 0, rings.spare.size)


# -- in turn with the caller -------------------------------------------------------------------------------------------


@inner
def _await_bytes(decoder, rings, control, began_ns, scratch):  # type: ignore[no-untyped-def]
    """Read as soon as something is there; ALL_TAKEN when it is decoded, or why the call ends."""
    while True:
        now = now_ns(scratch)
        due = control[ring.DUE_NS] + QUIET_NS  # better right behind a block: the caller's work then delays no other
        if control[ring.PATIENCE_NS]:
            due = min(due, max(control[ring.BLOCK_NS] + control[ring.PATIENCE_NS], began_ns + LEAST_WAIT_NS))
        overdue = now >= due  # what is there is read once even then
        over = overdue or control[ring.N_MESSAGES] >= control[ring.BUDGET]
        if control[ring.STOP] or (over and control[ring.N_ARRIVALS] > control[ring.FIRST]):
            return ring.DUE
        if control[ring.N_ARRIVALS] == control[ring.LIMIT] or control[ring.N_NOTES] == control[ring.LIMIT]:
            return ring.FULL
        awake = now < began_ns + control[ring.EAGER_NS]
        if not awake:
            ready = wait_for(control[ring.FD], due - now, np.bool_(False), scratch)
            if due > now:
                _note_wait(rings.notes, control, now, due, now_ns(scratch))
            if ready < 0:
                return _failed(control, ready)
            if ready == 0 and overdue:
                return ring.DUE
            if ready == 0:
                continue
        found = _read(decoder, control, scratch)
        if found > 0:
            return ring.ALL_TAKEN
        if found < 0 or not awake:
            if found == -AGAIN:
                continue
            return _failed(control, found)
        # a terminal says so when nothing is there


@inner
def _next_read(fed, reads, decoder, control):  # type: ignore[no-untyped-def]
    """Decode the next of the reads that were made elsewhere."""
    size, at = reads[control[ring.NEXT_READ], 0], control[ring.READ_AT]
    control[ring.ARRIVAL_NS] = reads[control[ring.NEXT_READ], 1]
    control[ring.NEXT_READ] += 1
    held = _make_room(decoder)
    copy_span(fed, _U(at), _U(at + size), decoder.buffer, _U(held))
    control[ring.READ_AT] += size
    _decode(decoder, control, held, size)


@inner
def _begin(walk, control):  # type: ignore[no-untyped-def]
    """Fill the present half of the rings from its beginning."""
    halves, half = control[ring.HALVES], control[ring.HALF]
    control[ring.FIRST], control[ring.LIMIT] = half * (ring.MANY // halves), (half + 1) * (ring.MANY // halves)
    control[ring.KEPT_LIMIT] = (half + 1) * (ring.KEPT_BYTES // halves)
    rows = walk.rows.size // halves
    control[ring.FIRST_ROW], control[ring.ROW_LIMIT] = half * rows, (half + 1) * rows
    for column in range(ring.ERRNO, ring.N_STEPS):
        control[column] = 0
    for column in range(ring.N_STEPS, ring.KEPT):
        control[column] = control[ring.FIRST]
    control[ring.KEPT] = half * (ring.KEPT_BYTES // halves)
    control[ring.URGENT] = 0
    walk.state[0].n_rows = control[ring.FIRST_ROW]


@inner
def _report(walk, control, ended):  # type: ignore[no-untyped-def]
    """Complete what `control` says of the call, or batch, that ends."""
    control[ring.STOP_ROW], control[ring.FOLLOWING] = walk.state[0].n_rows, walk.state[0].next_exposure
    control[ring.TOLD], control[ring.ENDED] = walk.state[0].told, ended


@inner
def _make_room(decoder):  # type: ignore[no-untyped-def]
    """Move what waits for the rest of its frame to the beginning of the buffer; return how many bytes those are."""
    buffer, tally = decoder.buffer, decoder.tally
    waiting, held = tally[wire.CONSUMED], tally[wire.HELD]
    if waiting:
        for i in range(held):
            buffer[i] = buffer[waiting + i]
        tally[wire.CONSUMED] = 0
    return held


@inner
def _decode(decoder, control, held, found):  # type: ignore[no-untyped-def]
    """Decode `found` new bytes behind `held` ones."""
    tally, used = decoder.tally, held + found
    control[ring.N_BODIES] = wire.unstuff_frames(decoder.buffer, used, _LIMIT, _SCHEMA, decoder.bodies, tally)
    control[ring.PLACE] = 0
    tally[wire.HELD] = used - tally[wire.CONSUMED]
    tally[wire.BYTES_IN] += found


@inner
def _failed(control, found):  # type: ignore[no-untyped-def]
    """Why a call ends whose wait or read gave `found`, 0 or minus errno."""
    control[ring.ERRNO] = -found
    return ring.SIGNALLED if found == -INTERRUPTED else ring.GONE


@inner
def _note_wait(notes, control, began, asked, ended):  # type: ignore[no-untyped-def]
    """Keep a wait for bytes; one that follows at once on a wait that ended in time is the same one (live/timing/causes.py)."""
    n = control[ring.N_NOTES]
    if n > control[ring.FIRST]:
        before = notes[n - 1]
        if before[2] - before[1] < OVERSLEPT_NS and began - min(before[1], before[2]) < control[ring.FLOOR_NS]:
            before[1], before[2] = asked, ended
            return
    notes[n, 0], notes[n, 1], notes[n, 2] = began, asked, ended
    control[ring.N_NOTES] += 1


@inner
def _read(decoder, control, scratch):  # type: ignore[no-untyped-def]
    """Read behind what waits in the buffer, stamp and decode it; return the bytes read, 0, or minus errno."""
    held = _make_room(decoder)
    found = read_now(control[ring.FD], decoder.buffer, held, min(READ_BYTES, decoder.buffer.size - held))
    if found > 0:
        control[ring.ARRIVAL_NS] = now_ns(scratch)
        _decode(decoder, control, held, found)
    return found


@inner
def take_bodies(decoder, walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    """Take decoded bodies until none is left, one is not ordinary, or a ring is nearly full; say which."""
    buffer, bodies = decoder.buffer, decoder.bodies
    while control[ring.PLACE] < control[ring.N_BODIES]:
        start, stop = bodies[control[ring.PLACE], 0], bodies[control[ring.PLACE], 1]
        if not _has_room(walk, control, stop - start):
            return ring.FULL
        if buffer[start] == _ACK and control[ring.DRIVES]:
            if load_session(buffer, start) != walk.state[0].session:
                return ring.ODD
            said = take_ack(buffer, _U(start), _U(stop), control)
            if said == IS_ODD:
                return ring.ODD
            _keep(buffer, start, stop, rings.kept, rings.answers, ring.N_ANSWERS, control)
            rings.answers[control[ring.N_ANSWERS] - 1, ring.WHAT] = ring.REFUSAL if said == IS_REFUSED else ring.DONE
            control[ring.PLACE] += 1
            continue
        if control[ring.SERVES] and (buffer[start] == _ACK or buffer[start] == _PONG):
            # an answer changes nothing that the core knows: the session gets it with the batch, from `answers`
            if load_session(buffer, start) != walk.state[0].session:
                return ring.ODD
            _keep(buffer, start, stop, rings.kept, rings.answers, ring.N_ANSWERS, control)
            if buffer[start] == _PONG:
                control[ring.PONG_NS] = control[ring.ARRIVAL_NS]
            control[ring.PLACE] += 1
            continue
        if not control[ring.OPEN]:
            return ring.ODD
        if control[ring.OPEN] >= 2 and _passes(buffer, start, stop, control):
            # the core judges it by where the stream stands now, when Python has time
            if load_session(buffer, start) != walk.state[0].session:
                return ring.ODD
            standing = rings.standings[control[ring.N_MESSAGES]]
            standing[0], standing[1] = walk.state[0].next_exposure, walk.state[0].drops
            standing[2], standing[3] = walk.state[0].last_tick, walk.state[0].jitter_ticks
            _keep(buffer, start, stop, rings.kept, rings.messages, ring.N_MESSAGES, control)
            control[ring.PLACE] += 1
            continue
        decoded_ns = now_ns(scratch)
        took = take_message(walk, buffer, _U(start), _U(stop))
        if took >= core.TOOK_MARK:
            stream.hear(buffer, _U(start), _U(stop), walk.heard, walk.state[0])
        if took >= core.TOOK_BLOCK:
            control[ring.URGENT] |= took - core.TOOK_BLOCK
            decided_ns = now_ns(scratch)
            sent = not control[ring.DRIVES] or answer(walk, drive, rings, control, scratch)
            _keep(buffer, start, stop, rings.kept, rings.messages, ring.N_MESSAGES, control)
            _put_step(walk, rings.steps, control, decoded_ns, decided_ns, now_ns(scratch))
            control[ring.PLACE] += 1
            if not sent:
                return ring.BROKEN
        elif took == core.TOOK_MARK:
            _keep(buffer, start, stop, rings.kept, rings.messages, ring.N_MESSAGES, control)
            control[ring.PLACE] += 1
        else:
            return ring.ODD
    return ring.ALL_TAKEN


@inner
def _passes(buffer, start, stop, control):  # type: ignore[no-untyped-def]
    """Whether the body is one that changes nothing of how the stream goes on: STATUS while the device measures, EXPOSED."""
    if buffer[start] == _EXPOSED:
        return control[ring.OPEN] == 3
    if buffer[start] != _STATUS or stop - start <= stream.BODY_HEADER:
        return False
    state = buffer[start + stream.BODY_HEADER]  # the first field
    return state in (_ARMED, _RUNNING)


@inner
def load_session(buffer, start):  # type: ignore[no-untyped-def]
    """The session of the body at `start`, int64."""
    return np.int64(load4(buffer, _U(start) + stream.SESSION_AT))


@inner
def _has_room(walk, control, size):  # type: ignore[no-untyped-def]
    """Whether another body of `size` bytes, what it answers and all its decisions fit into this half of the rings."""
    return (
        control[ring.KEPT] + size + ring.SHOW_BYTES <= control[ring.KEPT_LIMIT]
        and control[ring.N_STEPS] < control[ring.LIMIT]
        and control[ring.N_MESSAGES] < control[ring.LIMIT]
        and control[ring.N_ANSWERS] < control[ring.LIMIT]
        and control[ring.N_SHOWS] < control[ring.LIMIT]
        and walk.state[0].n_rows + control[ring.BLOCK_ROWS] <= control[ring.ROW_LIMIT]
    )


@inner
def _keep(buffer, start, stop, kept, spans, count, control):  # type: ignore[no-untyped-def]
    """Copy a body behind what is kept, and say where it stands; `count` is the column of `control` that counts the spans."""
    at = control[ring.KEPT]
    copy_span(buffer, _U(start), _U(stop), kept, _U(at))
    span = spans[control[count]]
    span[ring.BEGIN], span[ring.END], span[ring.TIME] = at, at + stop - start, control[ring.ARRIVAL_NS]
    span[ring.WHAT] = buffer[start]
    control[count] += 1
    control[ring.KEPT] = at + stop - start
    control[ring.HEARD_NS] = control[ring.ARRIVAL_NS]


@inner
def _put_step(walk, steps, control, decoded_ns, decided_ns, recorded_ns):  # type: ignore[no-untyped-def]
    """Keep when a block came, was decoded, decided and kept, and what has come of all up to it."""
    step = steps[control[ring.N_STEPS]]
    step[ring.ARRIVAL], step[ring.DECODED] = control[ring.ARRIVAL_NS], decoded_ns
    step[ring.DECIDED], step[ring.RECORDED] = decided_ns, recorded_ns
    step[ring.END_TICK], step[ring.ROWS] = walk.state[0].last_tick, walk.state[0].n_rows
    step[ring.MESSAGES], step[ring.SHOWS] = control[ring.N_MESSAGES], control[ring.N_SHOWS]
    control[ring.N_STEPS] += 1
    control[ring.BLOCK_NS] = control[ring.ARRIVAL_NS]


@outer
def unpack_blocks(kept, messages, stamps, bits):  # type: ignore[no-untyped-def]
    """Put the patterns shown and the clicks of all CLICKS among `messages` behind one another; return how many exposures fitted.

    kept uint8, messages int64 (n, 4), stamps uint16 and bits uint8 (m,).
    """
    used = np.int64(0)
    for i in range(messages.shape[0]):
        if messages[i, ring.WHAT] == stream.CLICKS:
            payload = _U(messages[i, ring.BEGIN] + stream.BODY_HEADER)
            count = stream.block_count(kept, payload)
            if used + count > stamps.size:
                break
            stream.unpack_clicks(kept, payload, count, stamps[used:], bits[used:])
            used += count
    return used
