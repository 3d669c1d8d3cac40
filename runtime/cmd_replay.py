"""`pans replay`: recompute a recording's decisions from its raw messages and compare the logs by hash.

Owns the command and the way from a recording back to a core; the decisions come from the same core.py as in the live run.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from .bundle import Bundle, load_bundle
from .cli import EXIT_ALERT, EXIT_FINE, Command, emit
from .connection import plan_from_chunks
from .core import Core
from .decide import make_decider
from .errors import DamagedFileError
from .record import DECISION_DTYPE, Recording, read_recording
from .wire import FrameDecoder, MalformedMessage, MessageType, Opcode, decode_command, unpack_body
from .wire_commands import Arm, PlanChunk, unpack_arm, unpack_plan


def replay(recording: Recording, bundle: Bundle) -> tuple[int, str]:
    """Return how many decisions `recording` gives with `bundle`, and the SHA-256 of their log."""
    config = recording.header.get("config", {})
    try:
        chunks, arm = sent_plan(recording)
        plan = plan_from_chunks(chunks, int(config["tick_hz"]))
        shots = int(config["shots"])
    except (KeyError, TypeError, ValueError, MalformedMessage) as error:
        raise DamagedFileError(f"{recording.path}: the run cannot be rebuilt: {error}") from error
    core = Core(
        plan, make_decider(bundle, shots=shots, backend=str(config.get("backend", "auto"))), shots, arm.n_cycles
    )
    core.start_tick = arm.start_tick
    log, n_decisions = hashlib.sha256(), 0
    for _, body in recording.messages():
        decisions: list[Any] = core.step(unpack_body(body)).decisions
        log.update(np.array(decisions, DECISION_DTYPE).tobytes())
        n_decisions += len(decisions)
    return n_decisions, log.hexdigest()


def sent_plan(recording: Recording) -> tuple[list[PlanChunk], Arm]:
    """Return the plan and the ARM command as they were sent to the device (repetitions left out)."""
    decoder = FrameDecoder()
    chunks: dict[int, PlanChunk] = {}
    arm: Arm | None = None
    for _, data in recording.commands():
        for frame in decoder.feed(data):
            if frame.type != MessageType.COMMAND:
                continue
            command = decode_command(frame.payload)
            if command.opcode == Opcode.LOAD_PLAN:
                chunk = unpack_plan(command.body)
                chunks[chunk.first_slot] = chunk
            elif command.opcode == Opcode.ARM:
                arm = unpack_arm(command.body)
    if arm is None:
        raise MalformedMessage("the device was never armed")
    return [chunks[first] for first in sorted(chunks)], arm


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="a recording (.pansrec)")
    parser.add_argument("--bundle", type=Path, help="decide with this bundle instead of the recorded one")


def _run(args: argparse.Namespace) -> int:
    recording = read_recording(args.recording)
    bundle = load_bundle(args.bundle)[0] if args.bundle else recording.bundle()
    n_decisions, sha256 = replay(recording, bundle)
    identical = sha256 == recording.decisions_sha256
    payload = {
        "decisions": n_decisions,
        "sha256": sha256,
        "recorded_sha256": recording.decisions_sha256,
        "identical": identical,
        "complete": recording.complete,
    }
    words = "identical" if identical else f"DIFFERENT from the recorded log ({recording.n_decisions} decisions)"
    emit(args, payload, f"{n_decisions} decisions, SHA-256 {sha256}: {words}")
    return EXIT_FINE if identical else EXIT_ALERT


REPLAY = Command("recompute a recording's decisions and compare", _configure, _run)
