"""A recording decided again: from its raw messages to decisions, by the same kernel and the same core as in the live run.

`replay` returns the number of decisions, the hash of their log, which is the recorded one when nothing has changed, and how far they
agree with a recording that was cut off. A `ClickLog` notes the clicks behind each decision on the way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.console import html_card
from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import likeness, npz_bytes, scene_arrays, shipped_scene, write_file
from pans.bundle.backends import Decider, PictureDecider, Verdict, Verdicts, make_decider
from pans.bundle.sensor import Bundle
from pans.decide import Decision, DecisionFlag, Follower, Place, RowDecisions, exposure_timing, rows_of
from pans.decide.dark import recorded_guard
from pans.decide.flow import FlowCore, PassageFigures, recorded_flow_core, replayed_figures
from pans.decide.kernel import StreamCore
from pans.decide.still import Core
from pans.instrument.profile import parse_profile
from pans.protocol.wire import Arm, MalformedMessage, MessageType, announces_exposed, decode_welcome, unpack_body
from pans.record.reading.decision_log import LogEncoder
from pans.record.reading.parts import JoinedRecording, place_of
from pans.record.reading.recording import Recording
from pans.record.reading.sent_plan import SHOTS, TICK_HZ, Sent, automaton_of, never_armed, sent_to_device, walk_dose

ASKED = DecisionFlag.NOT_FINITE | DecisionFlag.AMBIGUOUS  # abstained after the back end had been asked
_ABSTAINED, _ASKED = int(DecisionFlag.ABSTAINED), int(ASKED)  # an enumeration's operators cost a microsecond each
# what a header, or commands, of another hand than ours may raise where a run is rebuilt from them
_NOT_REBUILT = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, MalformedMessage)


class ClickLog(Decider):
    """Stands between a core and its back end, whichever, and remembers the clicks of every decision that it is asked for.

    It has neither `look_up` nor `automaton`: a kernel would decide by them, and ask for no label.
    """

    def __init__(self) -> None:
        self.counts: list[NDArray[np.int64]] = []
        self.decisions: list[Decision] = []
        self.shots = 1

    def over(self, decider: Decider) -> Decider:
        """Return the back end that the core is to ask."""
        self._back_end = decider
        self.name, self.n_features, self.n_classes = decider.name, decider.n_features, decider.n_classes
        self.largest = decider.largest
        return self

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """As `Decider`."""
        return self._back_end.scores_batch(counts, shots)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """As `Decider`."""
        return self._back_end.decide_batch(counts, shots)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """As `Decider`."""
        self.counts.append(counts.copy())
        self.shots = shots
        return self._back_end.decide(counts, shots)

    def verdicts(self, counts: NDArray[np.int64], shots: int) -> Verdicts:
        """Decide many at once, as the kernel asks for."""
        self.counts += list(counts.copy())
        self.shots = shots
        return self._back_end.verdicts(counts, shots)

    def note(self, decisions: Sequence[Decision]) -> None:
        """Take the decisions in their order: those that were asked for, in the order of asking."""
        self.decisions += [one for one in decisions if not one.flags & _ABSTAINED or one.flags & _ASKED]


@dataclass(frozen=True, slots=True)
class Replayed:
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
    exposure_timing: dict[str, Any]  # as in the summary; empty where the header has no profile

    @property
    def more(self) -> int:
        """Decisions beyond those that are recorded."""
        return max(0, self.decisions - self.recorded)

    def _repr_html_(self) -> str:
        facts = {name: getattr(self, name) for name in ("decisions", "recorded", "sha256")}
        return html_card("Replay", {"as recorded": "yes" if self.as_recorded else "NO"} | facts | self.contradictions)


def replay(recording: Recording, bundle: Bundle, pictures: ClickLog | None = None) -> Replayed:
    """Decide `recording` again with `bundle`; `pictures`, or another log, collects what the back end is asked.

    The `sha256` of a run in parts is that of one log, as if it had been recorded in one file.
    """
    if never_armed(recording):
        return Replayed(0, recording.decisions_sha256, None, 0, as_recorded=True, contradictions={}, exposure_timing={})
    core, log = _replayed(recording, bundle, pictures)
    passages = replayed_figures(core, recording.events()) if isinstance(core, FlowCore) else None
    sha256, recorded = log.encoder.hexdigest(), recording.decisions_sha256
    if isinstance(recording, JoinedRecording):  # whose hash is a chain: the replay's is over one log
        whole = LogEncoder()
        for rows in recording.iter_decisions():
            whole.update(rows)
        recorded = whole.hexdigest()
    agrees = (sha256 if recording.complete else log.sha256_as_far) == recorded
    told = log.decisions, sha256, passages, recording.n_decisions, agrees, dict(core.contradictions)
    return Replayed(*told, _exposure_timing(recording, core))


def _exposure_timing(recording: Recording, core: Follower) -> dict[str, Any]:
    toml = recording.profile_toml
    if not toml:
        return {}
    frames = (unpack_body(body) for _, body in recording.answers())
    welcomes = (decode_welcome(frame.payload) for frame in frames if frame.type == MessageType.WELCOME)
    announced = any(announces_exposed(welcome.facts) for welcome in welcomes)
    tolerance_us = parse_profile(toml, f"{recording.path}: its profile").exposure_tolerance_us(core.plan.exposure_us)
    return exposure_timing(core.exposed, core.plan.tick_us, tolerance_us, announced=announced, untold=core.untold)


class _Log:
    """The log of a replay; `sha256_as_far` is its hash after as many decisions as are recorded, "" while there are fewer."""

    def __init__(self, n_recorded: int, pictures: ClickLog | None) -> None:
        self.decisions = 0
        self.sha256_as_far = ""
        self._n_recorded, self._pictures = n_recorded, pictures
        self.encoder = LogEncoder()
        self.take(rows_of([]))

    def take(self, rows: NDArray[np.void]) -> None:
        here = self._n_recorded - self.decisions  # rows up to the last recorded one
        if 0 <= here <= len(rows) and not self.sha256_as_far:
            self.encoder.update(rows[:here])
            self.sha256_as_far = self.encoder.hexdigest()
            self.encoder.update(rows[here:])
        else:
            self.encoder.update(rows)
        self.decisions += len(rows)
        if self._pictures is not None:
            self._pictures.note(RowDecisions(rows))


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
    for rows in _decided(core, sent.arms, recording):
        log.take(rows)
    went_on = "part_ended" in recording.summary  # in the next part
    was_cut = not recording.complete and log.decisions >= recording.n_decisions  # the run did not end there
    if not (went_on or was_cut):
        log.take(rows_of(core.end().decisions))
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
        plan = sent.plan(tick_hz, decider.automaton or automaton, bundle.largest)
        if pictures is not None:
            decider = pictures.over(decider)
        guard = recorded_guard(config.get("dark", {}).get("guard", {}), plan, bundle, shots)
        if guard is not None and guard.policy == "warn":
            guard = None  # it changes no decision
        n_cycles = next(iter(sent.arms.values())).n_cycles
        if "flow" not in config:
            return Core(plan, decider, shots, n_cycles, guard), sent
        core = recorded_flow_core(config["flow"], plan, decider, bundle, shots, n_cycles)
        core.guard = guard
        return core, sent
    except _NOT_REBUILT as error:
        # Python's own words of a fact of another type say nothing to a reader.
        why = (
            "a fact of another type" if isinstance(error, (AttributeError, TypeError)) else error or "a fact is missing"
        )
        raise DamagedFileError(f"{recording.path}: the run cannot be rebuilt: {why}") from error


def replay_faults(recording: Recording, bundle: Bundle) -> list[str]:
    """Return why `recording` could not be replayed with `bundle`, [] if it can; nothing is decided.

    A recording of a run that never armed the device holds nothing to decide: its replay has no decisions, as it has.
    """
    try:
        if never_armed(recording):
            return []
        _, sent = _rebuilt(recording, bundle, None)
        place_of(recording)
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


def _decided(core: Core | FlowCore, arms: Mapping[int, Arm], recording: Recording) -> Iterator[NDArray[np.void]]:
    """Drive `core` by the kernel, as the live loop did, and yield its decisions; rows are valid until the next ones.

    Messages of another session than the present one begin the streams of the next ARMs.
    """
    streams, streamed = _begun(core, arms, place_of(recording)), StreamCore.of(core, 0)
    for messages in recording.iter_messages():
        for batch in streamed.replay(messages):
            yield batch.rows
            for frame in batch.others:
                while frame.session != streamed.session:
                    if (begun := next(streams, None)) is None:
                        raise DamagedFileError(f"{recording.path}: a message of a session that never armed the device")
                    session, rows = begun
                    yield rows
                    streamed.follow(session)
                yield rows_of(core.step(frame).decisions)
    yield from (rows for _, rows in streams)  # those that gave no message at all


def _begun(core: Follower, arms: Mapping[int, Arm], place: Place | None) -> Iterator[tuple[int, NDArray[np.void]]]:
    """Begin the stream of each ARM, the first one at the `place` of a later part; yield its session, and the decisions."""
    for session, arm in arms.items():
        output = core.begin(arm.start_tick, arm.n_cycles)
        if place is not None:
            core.resume(place)
            place = None
        yield session, rows_of(output.decisions)


TRUTH_MAX_BYTES = 1 << 26  # as a scene file


class PictureLog(ClickLog):
    """The log of a back end that returns pictures."""

    def over(self, decider: Decider) -> Decider:
        """Return the back end that the core is to ask; UsageError for one that returns no pictures."""
        if not isinstance(decider, PictureDecider):
            raise UsageError("the bundle decides among classes, it returns no pictures", remedy="leave --pictures out")
        self._pictures = decider
        return super().over(decider)

    def pictures(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the objects, int64 (n,), and their pictures cut to [0, 1], float32 (n, height, width)."""
        if len(self.decisions) != len(self.counts):
            raise ValueError(f"{len(self.counts)} decisions were asked for, {len(self.decisions)} came")
        if not self.counts:
            return np.zeros(0, np.int64), np.zeros((0, *self._pictures.picture_shape), np.float32)
        objects = np.array([decision.object for decision in self.decisions], np.int64)
        return objects, self._pictures.pictures(np.stack(self.counts), self.shots)

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write `object` and `pictures` to a .npz, whole or not at all; UsageError if it exists, unless `force`."""
        objects, pictures = self.pictures()
        write_file(path, npz_bytes(object=objects, pictures=pictures), force=force)

    def compare(self, truth: Path) -> dict[str, Any]:
        """Return SSIM and mean squared error against the scene in `truth` (.npz with `images`), whose objects pass in turn."""
        objects, pictures = self.pictures()
        images = _images(truth)
        alike = likeness(pictures, images[objects % len(images)])
        known = bool(len(objects))
        return {
            "ssim_mean": float(alike.ssim.mean()) if known else None,
            "mse_mean": float(alike.mse.mean()) if known else None,
            "pictures": len(objects),
        }


def _images(name: Path) -> NDArray[np.uint8]:
    path = name if name.exists() else shipped_scene(str(name)) or name
    return scene_arrays(path, TRUTH_MAX_BYTES)["images"]
