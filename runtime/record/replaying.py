"""A recording decided again: from its raw messages to decisions, with the same core as in the live run.

Owns the way from a recording back to a core and the frames' order; never judges. `replay` returns the number of decisions, the hash
of their log, which is the recorded one when nothing has changed, and how far they agree with a recording that was cut off. A `ClickLog`
notes the clicks behind each decision on the way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.dark_guard import recorded_guard
from pans.runtime.core.decision import DECISION_DTYPE, Decision, DecisionFlag
from pans.runtime.core.follower import Follower, Place
from pans.runtime.core.plan import Plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider, Verdict, Verdicts, verdicts_of
from pans.runtime.errors import DamagedFileError, UsageError
from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.make import recorded_flow_core, replayed_figures
from pans.runtime.flow.matching import PassageFigures
from pans.runtime.kernel.calls import StreamCore
from pans.runtime.ranges import Range
from pans.runtime.wire.commands import Arm
from pans.runtime.wire.messages import MalformedMessage, unpack_body

from .log import LogEncoder
from .parts import place_of
from .recording import Recording
from .sent_plan import TICK_HZ, Sent, automaton_of, never_armed, sent_to_device, walk_dose

ASKED = DecisionFlag.NOT_FINITE | DecisionFlag.AMBIGUOUS  # abstained after the back end had been asked
SHOTS = Range(1, 1 << 20, whole=True)
# what a header, or commands, of another hand than ours may raise where a run is rebuilt from them
_NOT_REBUILT = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, MalformedMessage)


class ClickLog:
    """Stands between a core and its back end, whichever, and remembers the clicks of every decision that it is asked for."""

    def __init__(self) -> None:
        self._decider: Decider | None = None
        self.counts: list[NDArray[np.int64]] = []
        self.decisions: list[Decision] = []
        self.shots = 1

    def over(self, decider: Decider) -> Decider:
        """Return the back end that the core is to ask."""
        self._decider = decider
        self.name, self.n_features, self.n_classes = decider.name, decider.n_features, decider.n_classes
        return self

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """As `Decider`."""
        self.counts.append(counts.copy())
        self.shots = shots
        return self._back_end.decide(counts, shots)

    def verdicts(self, counts: NDArray[np.int64], shots: int) -> Verdicts:
        """Decide many at once, as the compiled steps ask for."""
        self.counts += list(counts.copy())
        self.shots = shots
        return verdicts_of(self._back_end, counts, shots)

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """As `Decider`."""
        return self._back_end.scores_batch(counts, shots)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """As `Decider`."""
        return self._back_end.decide_batch(counts, shots)

    def note(self, decisions: Sequence[Decision]) -> None:
        """Take the decisions in their order: those that were asked for, in the order of asking."""
        self.decisions += [one for one in decisions if not one.flags & DecisionFlag.ABSTAINED or one.flags & int(ASKED)]

    @property
    def _back_end(self) -> Decider:
        assert self._decider is not None
        return self._decider


class Replayed(NamedTuple):
    """What a replay gave: how many decisions, the SHA-256 of their log, what those about passing objects were worth, the agreement.

    `contradictions` are those of the stream with the plan and with itself, by what is wrong, as the core counted them in the run.

    `as_recorded`: every recorded decision was made again, bit for bit, and, where the recording has its end, no other one. A
    recording that was cut off may hold messages of decisions that it has lost: there may be more than the `recorded` ones.
    """

    decisions: int
    sha256: str
    passages: PassageFigures | None
    recorded: int
    as_recorded: bool
    contradictions: dict[str, int]

    @property
    def more(self) -> int:
        """Decisions beyond those that are recorded."""
        return max(0, self.decisions - self.recorded)


def replay(recording: Recording, bundle: Bundle, pictures: ClickLog | None = None) -> Replayed:
    """Decide `recording` again with `bundle`; `pictures`, or another log, collects what the back end is asked."""
    if never_armed(recording):
        return Replayed(0, recording.decisions_sha256, None, 0, as_recorded=True, contradictions={})
    core, log = _replayed(recording, bundle, pictures)
    passages = replayed_figures(core, recording.events()) if isinstance(core, FlowCore) else None
    sha256 = log.sha256()
    same = sha256 if recording.complete else log.sha256_as_far
    agrees, told = same == recording.decisions_sha256, dict(core.contradictions)
    return Replayed(log.decisions, sha256, passages, recording.n_decisions, agrees, told)


class _Log:
    """The log of a replay; `sha256_as_far` is its hash after as many decisions as are recorded, "" while there are fewer."""

    def __init__(self, n_recorded: int, pictures: ClickLog | None) -> None:
        self.decisions = 0
        self.sha256_as_far = ""
        self._n_recorded, self._pictures = n_recorded, pictures
        self._encoder = LogEncoder()
        self.take([])

    def take(self, decisions: Sequence[Any] | NDArray[np.void]) -> None:
        rows = np.asarray(decisions, DECISION_DTYPE)
        here = self._n_recorded - self.decisions  # rows up to the last recorded one
        if 0 <= here <= len(rows) and not self.sha256_as_far:
            self._encoder.update(rows[:here])
            self.sha256_as_far = self._encoder.hexdigest()
            self._encoder.update(rows[here:])
        else:
            self._encoder.update(rows)
        self.decisions += len(rows)
        if self._pictures is not None and not isinstance(decisions, np.ndarray):
            self._pictures.note(decisions)

    def sha256(self) -> str:
        return self._encoder.hexdigest()


def replayed_flow(recording: Recording, bundle: Bundle) -> tuple[PassageFigures, NDArray[np.int64]]:
    """Return what a replay's decisions about passing objects were worth, and truth against decision (classes, classes).

    UsageError where nothing passed.
    """
    core, _ = _replayed(recording, bundle, None)
    if not isinstance(core, FlowCore):
        raise UsageError(f"{recording.path}: no objects flow past in this run")
    return replayed_figures(core, recording.events()), core.matcher.confusion


def _replayed(recording: Recording, bundle: Bundle, pictures: ClickLog | None) -> tuple[Core | FlowCore, _Log]:
    """Drive a core through `recording`; return it and the log of its decisions."""
    core, sent = _rebuilt(recording, bundle, pictures)
    log = _Log(recording.n_decisions, pictures)
    arms = list(sent.arms.items())
    if pictures is None and isinstance(core, Core) and core.takes:
        found = _by_kernel(core, arms, recording)
    else:
        found = _by_core(core, arms, recording)
    for decisions in found:
        log.take(decisions)
    went_on = "part_ended" in recording.summary  # in the next part
    was_cut = not recording.complete and log.decisions >= recording.n_decisions  # the run did not end there
    if not (went_on or was_cut):
        log.take(core.end().decisions)
    return core, log


def _rebuilt(recording: Recording, bundle: Bundle, pictures: ClickLog | None) -> tuple[Core | FlowCore, Sent]:
    """Return the core of the run, and what the device was sent.

    DamagedFileError if the header or the commands do not tell.
    """
    try:
        config = recording.header["config"]
        sent = sent_to_device(recording)
        tick_hz, shots = TICK_HZ.checked(config["tick_hz"], "tick_hz"), SHOTS.checked(config["shots"], "shots")
        automaton, confidence = automaton_of(config, bundle), float(config.get("confidence", 0.0))
        backend = str(config.get("backend", "auto"))
        decider = make_decider(bundle, shots=shots, backend=backend, confidence=confidence, dose=walk_dose(config))
        plan = sent.plan(tick_hz, getattr(decider, "automaton", automaton), bundle.largest)
        if pictures is not None:
            decider = pictures.over(decider)
        core = _core(config, plan, decider, bundle, shots, next(iter(sent.arms.values())).n_cycles)
        return core, sent
    except _NOT_REBUILT as error:
        raise DamagedFileError(
            f"{recording.path}: the run cannot be rebuilt: {error or type(error).__name__}"
        ) from error


def replay_faults(recording: Recording, bundle: Bundle) -> list[str]:
    """Return why `recording` could not be replayed with `bundle`, [] if it can; nothing is decided.

    A recording of a run that never armed the device holds nothing to decide: its replay has no decisions, as it has.
    """
    try:
        if never_armed(recording):
            return []
        _, sent = _rebuilt(recording, bundle, None)
        place = place_of(recording)
        if place is not None:
            Place.of(place)
        later, session = iter(sent.arms.items()), 0
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


class _Streams:
    """The streams of a run in their order: each ARM begins one, which has the session of its frames; a later part goes on in one."""

    def __init__(self, core: Follower, arms: list[tuple[int, Arm]], recording: Recording) -> None:
        self.session = 0
        self._core, self._following = core, iter(arms)
        self._place, self._path = place_of(recording), recording.path

    def begin_up_to(self, session: int) -> list[Any]:
        """Begin streams until that of `session`, and return the decisions; DamagedFileError if there is none."""
        decisions: list[Any] = []
        while session != self.session:
            if (begun := self._begin_next()) is None:
                raise DamagedFileError(f"{self._path}: a message of a session that never armed the device")
            decisions += begun
        return decisions

    def begin_rest(self) -> Iterator[Sequence[Any]]:
        """Begin the streams that gave no message at all, and yield the decisions."""
        while (begun := self._begin_next()) is not None:
            yield begun

    def _begin_next(self) -> Sequence[Any] | None:
        self.session, arm = next(self._following, (0, None))
        if arm is None:
            return None
        output = self._core.begin(arm.start_tick, arm.n_cycles)
        if self._place is not None:
            self._core.resume(Place.of(self._place))
            self._place = None
        return output.decisions


def _by_core(core: Follower, arms: list[tuple[int, Arm]], recording: Recording) -> Iterator[Sequence[Any]]:
    """Drive `core` as the live loop did, message by message."""
    streams = _Streams(core, arms, recording)
    for _, body in recording.messages():
        frame = unpack_body(body)
        if frame.session != streams.session:
            yield streams.begin_up_to(frame.session)
        yield core.step(frame).decisions
    yield from streams.begin_rest()


def _by_kernel(
    core: Core, arms: list[tuple[int, Arm]], recording: Recording
) -> Iterator[Sequence[Any] | NDArray[np.void]]:
    """Drive `core` as the live loop did, many messages in one call of the kernel; rows are valid until the next ones."""
    streams, streamed = _Streams(core, arms, recording), StreamCore.of(core, 0)
    for messages in recording.iter_messages():
        for batch in streamed.replay(messages):
            yield batch.rows
            for frame in batch.others:
                if frame.session != streams.session:
                    yield streams.begin_up_to(frame.session)
                    streamed.follow(frame.session)
                    yield core.step(frame).decisions
    yield from streams.begin_rest()
