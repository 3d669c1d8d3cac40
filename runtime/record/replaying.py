"""A recording decided again: from its raw messages to decisions, with the same core as in the live run.

Owns the way from a recording back to a core and the frames' order; never judges. `replay` returns the number of decisions and the hash
of their log, which is the recorded one when nothing has changed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.dark_guard import recorded_guard
from pans.runtime.core.decision import DECISION_DTYPE
from pans.runtime.core.follower import Follower, Place
from pans.runtime.core.plan import Plan
from pans.runtime.core.plan_codec import plan_from_chunks
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider
from pans.runtime.errors import DamagedFileError, UsageError
from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.make import recorded_flow_core, replayed_figures
from pans.runtime.flow.matching import PassageFigures
from pans.runtime.ranges import Range
from pans.runtime.wire.commands import Arm
from pans.runtime.wire.messages import MalformedMessage, unpack_body

from .format import Kind
from .log import LogEncoder
from .parts import place_of
from .pictures import PictureLog
from .recording import Recording
from .sent_plan import TICK_HZ, sent_plan

SHOTS = Range(1, 1 << 20, whole=True)
# what a header, or commands, of another hand than ours may raise where a run is rebuilt from them
_NOT_REBUILT = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, MalformedMessage)


class Replayed(NamedTuple):
    """What a replay gave: how many decisions, the SHA-256 of their log, and what those about passing objects were worth."""

    decisions: int
    sha256: str
    passages: PassageFigures | None


def replay(recording: Recording, bundle: Bundle, pictures: PictureLog | None = None) -> Replayed:
    """Decide `recording` again with `bundle`; `pictures` collects those given back."""
    core, n_decisions, sha256 = _replayed(recording, bundle, pictures)
    passages = replayed_figures(core, recording.events()) if isinstance(core, FlowCore) else None
    return Replayed(n_decisions, sha256, passages)


def replayed_flow(recording: Recording, bundle: Bundle) -> tuple[PassageFigures, NDArray[np.int64]]:
    """Return what a replay's decisions about passing objects were worth, and truth against decision (classes, classes).

    UsageError where nothing passed.
    """
    core, _, _ = _replayed(recording, bundle, None)
    if not isinstance(core, FlowCore):
        raise UsageError(f"{recording.path}: no objects pass by in this run")
    return replayed_figures(core, recording.events()), core.matcher.confusion


def _replayed(recording: Recording, bundle: Bundle, pictures: PictureLog | None) -> tuple[Core | FlowCore, int, str]:
    """Drive a core through `recording`; return it, the number of decisions and the SHA-256 of their log."""
    core, arms = _rebuilt(recording, bundle, pictures)
    log, n_decisions = LogEncoder(), 0
    for decisions in _decisions(core, arms, recording):
        log.update(np.array(decisions, DECISION_DTYPE))
        n_decisions += len(decisions)
        if pictures is not None:
            pictures.note(decisions)
    return core, n_decisions, log.hexdigest()


def _rebuilt(
    recording: Recording, bundle: Bundle, pictures: PictureLog | None
) -> tuple[Core | FlowCore, list[tuple[int, Arm]]]:
    """Return the core of the run and its ARM commands; DamagedFileError if the header or the commands do not tell."""
    try:
        config = recording.header["config"]
        chunks, arms = sent_plan(recording)
        tick_hz, shots = TICK_HZ.checked(config["tick_hz"], "tick_hz"), SHOTS.checked(config["shots"], "shots")
        plan = plan_from_chunks(chunks, tick_hz)
        decider = make_decider(bundle, shots=shots, backend=str(config.get("backend", "auto")))
        if pictures is not None:
            decider = pictures.over(decider)
        return _core(config, plan, decider, bundle, shots, arms[0][1].n_cycles), arms
    except _NOT_REBUILT as error:
        raise DamagedFileError(
            f"{recording.path}: the run cannot be rebuilt: {error or type(error).__name__}"
        ) from error


def replay_faults(recording: Recording, bundle: Bundle) -> list[str]:
    """Return why `recording` could not be replayed with `bundle`, [] if it can; nothing is decided.

    Nothing is said of a recording that holds no commands or no messages: it does not claim that it can be.
    """
    if not {Kind.MESSAGES, Kind.COMMANDS} <= recording.kinds.keys():
        return []
    try:
        _, arms = _rebuilt(recording, bundle, None)
        place = place_of(recording)
        if place is not None:
            Place.of(place)
        later, session = iter(arms), 0
        for _, body in recording.messages():
            frame = unpack_body(body)
            while frame.session != session:
                session = next(later)[0]
    except StopIteration:
        return ["a message of a session that never armed the device"]
    except UsageError as error:
        return [f"the run cannot be rebuilt: {error.message}"]
    except DamagedFileError as error:
        return [error.message]
    except _NOT_REBUILT as error:
        return [f"a message or the place where the part begins cannot be read: {error}"]
    return []


def _core(
    config: dict[str, Any], plan: Plan, decider: Decider, bundle: Bundle, shots: int, n_cycles: int
) -> Core | FlowCore:
    guard = recorded_guard(config.get("dark", {}).get("guard", {}), plan, bundle, shots)
    if "flow" not in config:
        return Core(plan, decider, shots, n_cycles, guard)
    core = recorded_flow_core(config["flow"], plan, decider, bundle, shots, n_cycles)
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
            core.resume(Place.of(place))
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
