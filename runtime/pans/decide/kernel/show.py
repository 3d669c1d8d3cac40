"""The host's answer to a block: where the walk continues, the SHOW command that names it, its bytes, its acknowledgement.

The kernel's form of live/drive.py (which state follows), of protocol/wire/framing.py for one short frame and of the ordinary
acknowledgement in protocol/session.py. It never allocates.
"""

from __future__ import annotations

import numpy as np

from pans.base.machine import inner, load2, load4
from pans.protocol.session import COMMAND_WINDOW
from pans.protocol.wire import ACK_DTYPE, HEADER, MAX_ACK_TEXT_BYTES, SCHEMA, STRUCTS, crc32_span, payload_offsets
from pans.protocol.wire import kernels as stream

from . import arrays as ring
from .system_calls import AGAIN, INTERRUPTED, now_ns, wait_for, write_now

ACK_BYTES = STRUCTS["ACK"].size
LAST_AT, REFUSED_AT, MASK_AT, STATUS_AT, TEXT_BYTES_AT = payload_offsets(
    ACK_DTYPE, "last_id", "refused_id", "refused_mask", "status", "text_bytes"
)
ID_AT, EXPOSURE_AT = HEADER.size, HEADER.size + STRUCTS["COMMAND"].size
TAIL_AT = EXPOSURE_AT + 8
IS_ODD, IS_DONE, IS_REFUSED = range(3)  # what `take_ack` says of an acknowledgement
WRITE_WAIT_NS = 20_000_000  # for room; what then is left, the caller sends
_U = np.uint64


@inner
def following(walk, drive):  # type: ignore[no-untyped-def]
    """Exposure and state of the next step: of the walk under way, or of the next one when this one is over or lost."""
    slots, walks = drive.sizes[0], drive.sizes[1]
    cycle = walk.state[0].next_exposure // slots
    step = drive.next_step[walk.state[0].next_exposure - cycle * slots]
    if step < drive.slot_of.size:
        state = _walk_state(walk, cycle // walks, cycle % walks, step)
        if state >= 0:
            return cycle * slots + drive.slot_of[step], state
    return (cycle + 1) * slots + drive.slot_of[0], np.int64(0)


@inner
def _walk_state(walk, visit, window, step):  # type: ignore[no-untyped-def]
    """As DecisionWindows.walk_state: -1 when the walk is over, or what came before is not known."""
    if visit != walk.state[0].visit:
        return np.int64(0) if step == 0 else np.int64(-1)
    node = walk.windows.walks.nodes[window]
    known = 0 <= node < walk.windows.walks.successors.shape[0] and walk.windows.seen[window, 0] == step
    return node if known else np.int64(-1)


@inner
def put_show(drive, number, exposure, state, out, at):  # type: ignore[no-untyped-def]
    """Put the frame of SHOW command `number` for `exposure` and `state` behind out[:at]; return where it ends."""
    plain, tail = drive.plain, drive.tails.shape[1]
    for i in range(4):
        plain[ID_AT + i] = np.uint8(number >> 8 * i & 0xFF)
    for i in range(8):
        plain[EXPOSURE_AT + i] = np.uint8(exposure >> 8 * i & 0xFF)
    for i in range(tail):
        plain[TAIL_AT + i] = drive.tails[state, i]
    size = TAIL_AT + tail
    crc = np.int64(crc32_span(plain, _U(0), _U(size), np.int64(SCHEMA)))
    for i in range(4):
        plain[size + i] = np.uint8(crc >> 8 * i & 0xFF)
    code_at, code = at, 1
    at += 1
    for i in range(size + 4):  # fewer than 254 bytes: no group is full
        if plain[i] == 0:
            out[code_at] = code
            code_at, code = at, 1
        else:
            out[at] = plain[i]
            code += 1
        at += 1
    out[code_at] = code
    out[at] = 0
    return at + 1


@inner
def send_show(walk, drive, rings, control, scratch):  # type: ignore[no-untyped-def]
    """Name what follows the exposures taken, unless that has been said; False when it could not be sent whole."""
    exposure, state = following(walk, drive)
    said = exposure == control[ring.SENT_EXPOSURE] and state == control[ring.SENT_STATE]
    if said or exposure >= walk.state[0].end_exposure:
        return True
    unanswered = control[ring.NEXT_ID] - control[ring.OLDEST_ID]
    if control[ring.WAITING] or unanswered >= COMMAND_WINDOW:
        return True  # what waits for acknowledgements comes late: the next walk is named in time
    begin = control[ring.KEPT]
    end = put_show(drive, control[ring.NEXT_ID], exposure, state, rings.kept, begin)
    sent = _send(control, rings.kept, begin, end, scratch)
    left_ns = now_ns(scratch)
    control[ring.SENT_EXPOSURE], control[ring.SENT_STATE] = exposure, state
    control[ring.NEXT_ID] += 1
    if unanswered == 0:
        control[ring.OLDEST_NS] = left_ns
    show = rings.shows[control[ring.N_SHOWS]]
    show[ring.BEGIN], show[ring.END], show[ring.TIME], show[ring.WHAT] = begin, end, left_ns, control[ring.ARRIVAL_NS]
    control[ring.N_SHOWS] += 1
    control[ring.KEPT] = end
    return sent


@inner
def _send(control, data, begin, end, scratch):  # type: ignore[no-untyped-def]
    """Write data[begin:end]; False, with the rest's size and errno in `control`, when the other end takes no more."""
    while begin < end:
        taken = write_now(control[ring.FD], data, begin, end - begin)
        if taken > 0:
            begin += taken
            continue
        if taken == -INTERRUPTED:
            continue
        if (taken == 0 or taken == -AGAIN) and wait_for(
            control[ring.FD], np.int64(WRITE_WAIT_NS), np.bool_(True), scratch
        ) > 0:
            continue
        control[ring.UNSENT], control[ring.ERRNO] = end - begin, -taken
        return False
    return True


@inner
def take_ack(buffer, start, stop, control):  # type: ignore[no-untyped-def]
    """Account for an acknowledgement that answers the oldest command, and say whether it is done or refused; else IS_ODD, and nothing done.

    A refusal is taken of a single SHOW of this call: what is named late is refused, and must not make the next name late.
    """
    at = start + _U(stream.BODY_HEADER)
    if stop - at < _U(ACK_BYTES) or control[ring.WAITING]:
        return IS_ODD
    last, refused = np.int64(load4(buffer, at + LAST_AT)), np.int64(load4(buffer, at + REFUSED_AT))
    status, text_bytes = load2(buffer, at + STATUS_AT), load2(buffer, at + TEXT_BYTES_AT)
    if stop - at != _U(ACK_BYTES) + text_bytes or text_bytes > _U(MAX_ACK_TEXT_BYTES) or (status and not refused):
        return IS_ODD
    oldest = control[ring.OLDEST_ID]
    if not oldest <= last < control[ring.NEXT_ID] or last - oldest > COMMAND_WINDOW:
        return IS_ODD
    fresh = load4(buffer, at + MASK_AT) & ((_U(2) << _U(last - oldest)) - _U(1))
    own = oldest >= control[ring.FIRST_ID]
    is_refused = refused == last and last == oldest and own and status != _U(0) and fresh == _U(1)
    if not is_refused and (fresh != _U(0) or refused >= oldest):
        return IS_ODD  # an earlier refusal stays named, and has been told
    control[ring.OLDEST_ID], control[ring.OLDEST_NS] = last + 1, control[ring.ARRIVAL_NS]
    return IS_REFUSED if is_refused else IS_DONE
