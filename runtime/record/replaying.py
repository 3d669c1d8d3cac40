"""A recording decided again: from its raw messages to decisions, with the same core as in the live run.

Owns the way from a recording back to a core and the frames' order; never judges. `replay` returns the number of decisions, the hash
of their log, which is the recorded one when nothing has changed, and how far they agree with a recording that was cut off.
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
from .sent_plan import TICK_HZ, never_armed, sent_plan

SHOTS = Range(1, 1 << 20, whole=True)
# what a header, or commands, of another hand than ours may raise where a run is rebuilt from them
_NOT_REBUILT = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, MalformedMessage)


class Replayed(NamedTuple):
    """What a replay gave: how many decisions, the SHA-256 of their log, what those about passing objects were worth, the agreement.

    `as_recorded`: every recorded decision was made again, bit for bit, and, where the recording has its end, no other one. A
    recording that was cut off may hold messages of decisions that it has lost: there may be more than the `recorded` ones.
    """

    decisions: int
    sha256: str
    passages: PassageFigures | None
    recorded: int
    as_recorded: bool

    @property
    def more(self) -> int:
        """Decisions beyond those that are recorded."""
        return max(0, self.decisions - self.recorded)


def replay(recording: Recording, bundle: Bundle, pictures: PictureLog | None = None) -> Replayed:
    """Decide `recording` again with `bundle`; `pictures` collects those given back."""
    if never_armed(recording):
        return Replayed(0, recording.decisions_sha256, None, 0, as_recorded=True)
    core, log = _replayed(recording, bundle, pictures)
    passages = replayed_figures(core, recording.events()) if isinstance(core, FlowCore) else None
    sha256 = log.sha256()
    same = sha256 if recording.complete else log.sha256_as_far
    return Replayed(log.decisions, sha256, passages, recording.n_decisions, same == recording.decisions_sha256)


class _Log:
    """The log of a replay; `sha256_as_far` is its hash after as many decisions as are recorded, "" while there are fewer."""

    def __init__(self, n_recorded: int, pictures: PictureLog | None) -> None:
        self.decisions = 0
        self.sha256_as_far = ""
        self._n_recorded, self._pictures = n_recorded, pictures
        self._encoder = LogEncoder()
        self.take([])

    def take(self, decisions: list[Any]) -> None:
        rows = np.array(decisions, DECISION_DTYPE)
        here = self._n_recorded - self.decisions  # rows up to the last recorded one
        if 0 <= here <= len(rows) and not self.sha256_as_far:
            self._encoder.update(rows[:here])
            self.sha256_as_far = self._encoder.hexdigest()
            self._encoder.update(rows[here:])
        else:
            self._encoder.update(rows)
        self.decisions += len(rows)
        if self._pictures is not None:
            self._pictures.note(decisions)

    def sha256(self) -> str:
        return self._encoder.hexdigest()


def replayed_flow(recording: Recording, bundle: Bundle) -> tuple[PassageFigures, NDArray[np.int64]]:
    """Return what a replay's decisions about passing objects were worth, and truth against decision (classes, classes).

    UsageError where nothing passed.
    """
    core, _ = _replayed(recording, bundle, None)
    if not isinstance(core, FlowCore):
        raise UsageError(f"{recording.path}: no objects pass by in this run")
    return replayed_figures(core, recording.events()), core.matcher.confusion


def _replayed(recording: Recording, bundle: Bundle, pictures: PictureLog | None) -> tuple[Core | FlowCore, _Log]:
    """Drive a core through `recording`; return it and the log of its decisions."""
    core, arms = _rebuilt(recording, bundle, pictures)
    log = _Log(recording.n_decisions, pictures)
    for decisions in _decisions(core, arms, recording):
        log.take(decisions)
    went_on = "part_ended" in recording.summary  # in the next part
    was_cut = not recording.complete and log.decisions >= recording.n_decisions  # the run did not end there
    if not (went_on or was_cut):
        log.take(core.end().decisions)
    return core, log


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
    if not {Kind.MESSAGES, Kind.COMMANDS} <= recording.kinds.keys() or never_armed(recording):
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
