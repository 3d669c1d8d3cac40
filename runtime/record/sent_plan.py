"""The plan and the ARM commands of a recording, as they were sent to the device.

Owns the way back from recorded commands; a plan's own form is core/plan_codec.py's.
"""

from __future__ import annotations

from pans.runtime.core.plan import Plan
from pans.runtime.core.plan_codec import plan_from_chunks
from pans.runtime.errors import DamagedFileError
from pans.runtime.ranges import Range
from pans.runtime.wire.commands import Arm, PlanChunk, unpack_arm, unpack_plan
from pans.runtime.wire.messages import FrameDecoder, MalformedMessage, MessageType, Opcode, decode_command

from .recording import Recording

TICK_HZ = Range(1000, 10_000_000_000, whole=True)


def never_armed(recording: Recording) -> bool:
    """Whether the run ended before it armed the device, so that there was nothing to decide."""
    if recording.n_decisions:
        return False
    decoder = FrameDecoder()
    return not any(
        frame.type == MessageType.COMMAND and decode_command(frame.payload).opcode == Opcode.ARM
        for _, data in recording.commands()
        for frame in decoder.feed(data)
    )


def sent_plan(recording: Recording) -> tuple[list[PlanChunk], list[tuple[int, Arm]]]:
    """Return the plan and the ARM commands with their sessions, as they were sent to the device (repetitions left out)."""
    decoder = FrameDecoder()
    chunks: dict[int, PlanChunk] = {}
    arms: dict[int, Arm] = {}
    for _, data in recording.commands():
        for frame in decoder.feed(data):
            if frame.type != MessageType.COMMAND:
                continue
            command = decode_command(frame.payload)
            if command.opcode == Opcode.LOAD_PLAN:
                chunk = unpack_plan(command.body)
                chunks[chunk.first_slot] = chunk
            elif command.opcode == Opcode.ARM:
                arms[frame.session] = unpack_arm(command.body)
    if not arms:
        raise MalformedMessage("the device was never armed")
    return [chunks[first] for first in sorted(chunks)], list(arms.items())


def recorded_plan(recording: Recording) -> Plan:
    """Return the plan that the device was sent; DamagedFileError if the recording does not hold it whole."""
    try:
        chunks, _ = sent_plan(recording)
        return plan_from_chunks(chunks, TICK_HZ.checked(recording.header["config"]["tick_hz"], "tick_hz"))
    except (KeyError, TypeError, ValueError, MalformedMessage) as error:
        raise DamagedFileError(f"{recording.path}: its plan cannot be rebuilt: {error}") from error
