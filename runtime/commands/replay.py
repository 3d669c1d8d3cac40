"""`pans replay`: recompute a recording's decisions from its raw messages and compare the logs by hash.

Owns the command and the way from a recording back to a core; the decisions come from the same core.py as in the live run.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, emit
from pans.runtime.core.decision import DECISION_DTYPE
from pans.runtime.core.follower import Follower
from pans.runtime.core.plan import Plan
from pans.runtime.core.plan_codec import plan_from_chunks
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider
from pans.runtime.errors import DamagedFileError, UsageError
from pans.runtime.flow.core import FlowCore
from pans.runtime.record.log import log_hash
from pans.runtime.record.parts import parts_in, place_of
from pans.runtime.record.recorder import Recording, read_recording
from pans.runtime.report.pictures import PictureLog
from pans.runtime.wire.commands import Arm, PlanChunk, unpack_arm, unpack_plan
from pans.runtime.wire.messages import FrameDecoder, MalformedMessage, MessageType, Opcode, decode_command, unpack_body

from .run_dark import made_guard
from .run_flow import passage_words, replayed_core, replayed_figures


def replay(
    recording: Recording,
    bundle: Bundle,
    pictures: PictureLog | None = None,
    figures: dict[str, Any] | None = None,
) -> tuple[int, str]:
    """Return how many decisions `recording` gives with `bundle`, and the SHA-256 of their log.

    `pictures` collects those given back, `figures` what the decisions about passing objects were worth.
    """
    core, n_decisions, sha256 = _replayed(recording, bundle, pictures)
    if figures is not None and isinstance(core, FlowCore):
        figures |= replayed_figures(core, recording.events())
    return n_decisions, sha256


def replayed_flow(recording: Recording, bundle: Bundle) -> tuple[dict[str, Any], NDArray[np.int64]]:
    """Return what a replay's decisions about passing objects were worth, and truth against decision (classes, classes).

    UsageError where nothing passed.
    """
    core, _, _ = _replayed(recording, bundle, None)
    if not isinstance(core, FlowCore):
        raise UsageError(f"{recording.path}: no objects pass by in this run")
    return replayed_figures(core, recording.events()), core.matcher.confusion


def _replayed(recording: Recording, bundle: Bundle, pictures: PictureLog | None) -> tuple[Core | FlowCore, int, str]:
    """Drive a core through `recording`; return it, the number of decisions and the SHA-256 of their log."""
    config = recording.header.get("config", {})
    try:
        chunks, arms = sent_plan(recording)
        plan = plan_from_chunks(chunks, int(config["tick_hz"]))
        shots = int(config["shots"])
    except (KeyError, TypeError, ValueError, MalformedMessage) as error:
        raise DamagedFileError(f"{recording.path}: the run cannot be rebuilt: {error}") from error
    decider = make_decider(bundle, shots=shots, backend=str(config.get("backend", "auto")))
    if pictures is not None:
        decider = pictures.over(decider)
    core = _core(config, plan, decider, bundle, shots, arms[0][1].n_cycles)
    log, n_decisions = log_hash(recording.version), 0
    for decisions in _decisions(core, arms, recording):
        log.update(np.array(decisions, DECISION_DTYPE))
        n_decisions += len(decisions)
        if pictures is not None:
            pictures.note(decisions)
    return core, n_decisions, log.hexdigest()


def _core(
    config: dict[str, Any], plan: Plan, decider: Decider, bundle: Bundle, shots: int, n_cycles: int
) -> Core | FlowCore:
    guard = made_guard(config.get("dark", {}).get("guard", {}), plan, bundle, shots)
    if "flow" not in config:
        return Core(plan, decider, shots, n_cycles, guard)
    core = replayed_core(config["flow"], plan, decider, bundle, shots, n_cycles)
    core.guard = guard
    return core


def _decisions(core: Follower, arms: list[tuple[int, Arm]], recording: Recording) -> Iterator[list[Any]]:
    """Drive `core` as the live loop did: each ARM begins a stream, which has the session of its frames; a later part goes on in one."""
    following = iter(arms)
    session, place = 0, place_of(recording)

    def begin_next() -> list[Any]:
        nonlocal session, place
        session, arm = next(following)
        output = core.begin(arm.start_tick, arm.n_cycles)
        if place is not None:
            core.resume(place)
            place = None
        return output.decisions

    for _, body in recording.messages():
        frame = unpack_body(body)
        while frame.session != session:
            try:
                yield begin_next()
            except StopIteration:
                raise DamagedFileError(
                    f"{recording.path}: a message of a session that never armed the device"
                ) from None
        yield core.step(frame).decisions
    for _ in range(len(arms)):  # streams that gave no message at all
        try:
            yield begin_next()
        except StopIteration:
            break
    if "part_ended" not in recording.summary:  # the run went on in the next part
        yield core.end().decisions


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


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="a recording (.pansrec), or a folder with one in parts")
    parser.add_argument("--bundle", type=Path, help="decide with this bundle instead of the recorded one")
    parser.add_argument("--pictures", type=Path, metavar="OUT.npz", help="write the pictures that the head gives back")
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="SCENE.npz",
        help="compare these pictures with the scene's images (SSIM, squared error)",
    )


def _run(args: argparse.Namespace) -> int:
    if args.recording.is_dir():
        return _run_parts(args)
    recording = read_recording(args.recording)
    bundle = load_bundle(args.bundle)[0] if args.bundle else recording.bundle()
    pictures = PictureLog() if args.pictures or args.truth else None
    figures: dict[str, Any] = {}
    n_decisions, sha256 = replay(recording, bundle, pictures, figures)
    identical = sha256 == recording.decisions_sha256
    payload = {
        "decisions": n_decisions,
        "sha256": sha256,
        "recorded_sha256": recording.decisions_sha256,
        "identical": identical,
        "complete": recording.complete,
        **figures,
    }
    if pictures is not None and args.pictures:
        pictures.write(args.pictures)
    if pictures is not None and args.truth:
        payload |= pictures.compare(args.truth)
    words = "identical" if identical else f"DIFFERENT from the recorded log ({recording.n_decisions} decisions)"
    emit(args, payload, "\n".join([f"{n_decisions} decisions, SHA-256 {sha256}: {words}", *_passage_words(figures)]))
    return EXIT_FINE if identical else EXIT_ALERT


def _passage_words(figures: Mapping[str, Any]) -> list[str]:
    return passage_words(figures) if "passages" in figures else []


def _run_parts(args: argparse.Namespace) -> int:
    """Replay each part of a recording by itself."""
    rows: list[dict[str, Any]] = []
    for path in parts_in(args.recording):
        recording = read_recording(path)
        bundle = load_bundle(args.bundle)[0] if args.bundle else recording.bundle()
        figures: dict[str, Any] = {}
        n_decisions, sha256 = replay(recording, bundle, None, figures)
        same = sha256 == recording.decisions_sha256
        rows.append({"part": path.name, "decisions": n_decisions, "sha256": sha256, "identical": same, **figures})
    identical = all(row["identical"] for row in rows)
    payload = {"decisions": sum(row["decisions"] for row in rows), "identical": identical, "parts": rows}
    lines = []
    for row in rows:
        lines += [
            f"{row['part']}: {row['decisions']} decisions: {'identical' if row['identical'] else 'DIFFERENT'}",
            *_passage_words(row),
        ]
    emit(args, payload, "\n".join(lines))
    return EXIT_FINE if identical else EXIT_ALERT


REPLAY = Command("recompute a recording's decisions and compare", _configure, _run)
