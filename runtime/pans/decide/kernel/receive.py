"""One call of the kernel: wait, read, resynchronise, check, decide, name the next state, keep what came.

It continues by itself with all that is ordinary and leaves the rest, untouched and in its place, to the caller. Bytes are decoded by
protocol/wire/kernels.py, messages taken by the kernel of the core's kind (`Walk.kernel`: still/kernels.py, flow/kernels.py), commands
written by show.py. It never allocates.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from pans.base.machine import bare, copy_span, inner, load4, outer
from pans.decide.still import kernels as core
from pans.decide.still.kernels import WalkArrays
from pans.protocol.wire import MAX_FRAME_BYTES, SCHEMA, MessageType
from pans.protocol.wire import kernels as stream
from pans.protocol.wire import kernels as wire

from . import arrays as ring
from .arrays import OVERSLEPT_NS
from .show import IS_ODD, IS_REFUSED, send_show, take_ack
from .system_calls import AGAIN, INTERRUPTED, now_ns, read_now, wait_for


@inner
def _answer_nothing(walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    return np.bool_(True)


def answering(kind: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the kernel that answers a block of a walk of class `kind`, and no names: it wants the whole walk."""
    return (send_show if kind is WalkArrays else _answer_nothing), ()


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

else:

    @intrinsic
    def take_message(context, walk, buffer, start, stop):  # type: ignore[no-untyped-def]
        """Take the message from `start` to `stop`, uint64, of `buffer`: by the kernel of the walk's kind."""
        return _typed(walk.instance_class.kernel(), context, walk, (buffer, start, stop))

    @intrinsic
    def answer(context, walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
        """Answer a block that has been taken; False when that could not be sent whole."""
        return _typed(answering(walk.instance_class), context, walk, (drive, rings, control, scratch))


READ_BYTES = 1 << 16  # at once, as protocol/links/serial.py
LEAST_WAIT_NS = 200_000
QUIET_NS = 5_000_000
_ACK = int(MessageType.ACK)
_U = np.uint64
_LIMIT, _SCHEMA = np.int64(MAX_FRAME_BYTES), np.int64(SCHEMA)  # plain numbers are types of their own to the compiler


@outer
def turn(fed, reads, decoder, walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    """Take what is decoded, then read and take until something is due or not ordinary; return why it ended (rings.WHY).

    decoder Decoder, walk of a class with a `kernel()`, drive Drive, rings Rings, control int64 (N_CONTROL,), scratch int64 (4,). Rings
    are filled from their beginning. Where there are `reads`, nothing is read but `fed` uint8, read by read: `reads` int64 (n, 2) are their
    bytes and the times of their arrival, control[NEXT_READ] and control[READ_AT] say which one comes next, and where it begins; ALL_TAKEN
    behind the last one.
    """
    decoder, walk, drive, rings = bare(decoder), bare(walk), bare(drive), bare(rings)
    fed, reads, control, scratch = bare(fed), bare(reads), bare(control), bare(scratch)
    _begin(walk, control)
    # before the first read neither the clock nor the blocks are looked at
    began_ns, blocks = np.int64(-1), np.int64(-1)
    while True:
        ended = take_bodies(decoder, walk, drive, rings, control, scratch)
        if ended == ring.ALL_TAKEN and reads.shape[0]:
            if control[ring.NEXT_READ] == reads.shape[0]:
                return ended
            if control[ring.N_ARRIVALS] == rings.arrivals.size:
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
        if control[ring.STOP] or (over and control[ring.N_ARRIVALS] > control[ring.FIRST_ARRIVAL]):
            return ring.DUE
        if control[ring.N_ARRIVALS] == rings.arrivals.size or control[ring.N_NOTES] == rings.notes.shape[0]:
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
    """Nothing has come in this call yet, unless it adds to the last one."""
    if not control[ring.ADDS]:
        for column in range(ring.ERRNO, ring.N_CONTROL):
            control[column] = 0
        control[ring.FIRST_ID], control[ring.URGENT] = control[ring.NEXT_ID], 0
        walk.state[0].n_rows = 0
    control[ring.FIRST_NOTE], control[ring.FIRST_ARRIVAL] = control[ring.N_NOTES], control[ring.N_ARRIVALS]


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
    if n > control[ring.FIRST_NOTE]:
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
        if not _has_room(walk, rings, control, stop - start):
            return ring.FULL
        if buffer[start] == _ACK and control[ring.DRIVES]:
            if load_session(buffer, start) != walk.state[0].session:
                return ring.ODD
            said = take_ack(buffer, _U(start), _U(stop), control)
            if said == IS_ODD:
                return ring.ODD
            _keep(buffer, start, stop, rings.kept, rings.answers, ring.N_ANSWERS, control)
            if said == IS_REFUSED:
                rings.answers[control[ring.N_ANSWERS] - 1, ring.WHAT] = ring.REFUSAL
            control[ring.PLACE] += 1
            continue
        if not control[ring.OPEN]:
            return ring.ODD
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
def load_session(buffer, start):  # type: ignore[no-untyped-def]
    """The session of the body at `start`, int64."""
    return np.int64(load4(buffer, _U(start) + stream.SESSION_AT))


@inner
def _has_room(walk, rings, control, size):  # type: ignore[no-untyped-def]
    """Whether another body of `size` bytes, what it answers and all its decisions fit into the rings."""
    return (
        control[ring.KEPT] + size + ring.SHOW_BYTES <= rings.kept.size
        and control[ring.N_STEPS] < rings.steps.shape[0]
        and control[ring.N_MESSAGES] < rings.messages.shape[0]
        and control[ring.N_ANSWERS] < rings.answers.shape[0]
        and control[ring.N_SHOWS] < rings.shows.shape[0]
        and walk.state[0].n_rows + control[ring.BLOCK_ROWS] <= walk.rows.size
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
