"""The checks behind `pans verify`: is this file whole, and can what it says be true?

`verify_file` never raises for what a file holds: it returns a `Verdict` with alerts (odd, usable), violations (a claim that does not hold)
and damage (not readable as it was written).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import ConfigError, DamagedFileError, PansError, UsageError
from pans.base.files import open_regular
from pans.bundle.automaton import Automaton
from pans.bundle.backends import NO_LABEL, OnnxDecider, make_decider
from pans.bundle.sensor import GOLDEN_WORK_MAX, Bundle, bundle_path, golden_violation, load_bundle, word_means
from pans.bundle.sensor import MAGIC as BUNDLE_MAGIC
from pans.calibrate.registration import is_registration, load_registration
from pans.decide import DecisionFlag
from pans.instrument.calibration_file import find_warnings, load_calibration, now_utc
from pans.instrument.profile import load_profile, parse_profile, shipped_profiles
from pans.protocol.session import ANSWER_TYPES
from pans.protocol.wire import MalformedMessage, unpack_body
from pans.record.reading import MAGIC as RECORDING_MAGIC
from pans.record.reading import (
    Recording,
    chain_violations,
    first_decision,
    is_of_parts,
    missing_parts,
    parts_in,
    read_recording,
    stem_of,
)
from pans.record.replay import replay_faults

_COMPARE_FEATURES_MAX = 16
_COMPARE_SCORES = 1 << 20  # at once
_ABSTAIN_CAUSES = DecisionFlag.GAP | DecisionFlag.WRONG_PATTERN | DecisionFlag.INCOMPLETE


@dataclass(slots=True)
class FileVerdict:
    """What was found in one file; `damaged` when it cannot be read as it was written."""

    path: str
    kind: str
    alerts: list[str] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    damaged: bool = False
    cut: bool = False  # a recording whose run did not close it

    @property
    def ok(self) -> bool:
        """Nothing at all to report."""
        return not (self.alerts or self.violations or self.damaged)


def file_kind(path: str | Path) -> str:
    """Return `bundle`, `recording`, `profile`, `calibration` or `registration`.

    UsageError for a missing file, DamagedFileError for anything else.
    """
    if str(path) in shipped_profiles() and not Path(path).exists():
        return "profile"
    if is_of_parts(path):
        return "recording"
    with open_regular(bundle_path(path)) as file:
        start = file.read(len(BUNDLE_MAGIC))
    suffixes = {".pans": "bundle", ".pansrec": "recording", ".toml": "profile", ".json": "calibration"}
    by_magic = {BUNDLE_MAGIC: "bundle", RECORDING_MAGIC: "recording"}
    kind = by_magic.get(start) or suffixes.get(Path(path).suffix)  # a damaged magic still has its name
    if kind == "calibration" and is_registration(path):
        kind = "registration"
    if kind is None:
        raise DamagedFileError(
            f"{path}: it starts with the bytes {start.hex(' ')}, which is no file of this project",
            remedy="allowed: bundles (.pans), recordings (.pansrec), profiles (.toml, or a shipped name), calibrations (.json)",
        )
    return kind


def verify_file(path: str | Path) -> FileVerdict:
    """Check one file as its kind demands; UsageError only if it is not there."""
    verdict = FileVerdict(str(path), "unknown")
    try:
        verdict.kind = file_kind(path)
        if verdict.kind == "bundle":
            _verify_bundle(load_bundle(path)[0], verdict)
        elif verdict.kind == "recording":
            _verify_recording(read_recording(path), verdict)
        elif verdict.kind == "calibration":
            verdict.alerts += find_warnings(load_calibration(path), now_utc())
        elif verdict.kind == "registration":
            verdict.alerts += load_registration(path).age_warnings(now_utc())
        else:
            load_profile(str(path))
    except UsageError:
        raise
    except (DamagedFileError, ConfigError) as error:
        verdict.damaged = True
        verdict.violations.append(error.message)
        if verdict.kind == "recording":
            verdict.violations += _what_survives(path)
    return verdict


def verify_parts(place: str | Path) -> list[FileVerdict]:
    """Check each part of the recordings in the folder `place`, or of the recording `place`, and the chain from part to part.

    UsageError if no parts are there.
    """
    paths = parts_in(place)
    verdicts = [verify_file(path) for path in paths]
    damaged = {verdict.path for verdict in verdicts if verdict.damaged}
    chain = FileVerdict(str(place), "parts")
    for stem in sorted({stem_of(path) for path in paths}):
        _verify_chain([path for path in paths if stem_of(path) == stem], damaged, chain)
    return [*verdicts, chain]


def _verify_chain(paths: list[Path], damaged: set[str], chain: FileVerdict) -> None:
    """Check what is between the parts of one recording, and what is missing."""
    whole = [read_recording(path) for path in paths if str(path) not in damaged]
    try:
        chain.violations += missing_parts(whole)
        if len(whole) < len(paths):
            chain.violations.append("the chain cannot be checked: a part is damaged")
        else:
            chain.violations += chain_violations(whole)
    except DamagedFileError as error:
        chain.violations.append(error.message)


def _what_survives(path: str | Path) -> list[str]:
    try:
        left = read_recording(path, salvage=True)
    except PansError:
        return []
    return [f"{path}: {left.n_decisions} decisions in the first {left.end_offset} bytes are readable"]


def _verify_bundle(bundle: Bundle, verdict: FileVerdict) -> None:
    """Golden vectors on every back end, table against head on every word, and signs of a bad export."""
    parts = {
        **{"table": bundle.table, "onnx": bundle.head_onnx, "int8": bundle.int8_head, "int8-onnx": bundle.int8_onnx},
        "automaton": bundle.automaton,
        # what a run may choose in place of these: where one refuses the bundle, the run does
        **dict.fromkeys(("sparse", "count-table"), bundle.head_onnx if bundle.picture_shape is None else None),
    }
    for backend, part in parts.items():
        if part is not None:
            try:
                make_decider(bundle, backend=backend)
            except DamagedFileError as error:
                verdict.violations.append(error.message)
            except UsageError:  # the head is no chain of layers, or has too many words for a table: a run does without
                if backend in ("table", "onnx", "int8", "int8-onnx", "automaton"):
                    raise
    if verdict.violations:
        return
    verdict.violations += _table_differences(bundle)
    verdict.alerts += _bundle_alerts(bundle)


def _table_differences(bundle: Bundle) -> list[str]:
    """Compare table and head on click words, on all of them where that is not too much work, else on some, evenly spread."""
    if bundle.table is None or bundle.head_onnx is None or bundle.n_features > _COMPARE_FEATURES_MAX:
        return []
    decider = OnnxDecider(bundle)
    n_words, at_once = len(bundle.table), max(1, _COMPARE_SCORES // bundle.n_classes)
    count = max(1, min(n_words, GOLDEN_WORK_MAX // decider.operations))
    chosen = np.arange(count) * n_words // count
    for start in range(0, count, at_once):
        words = chosen[start : start + at_once]
        numbers = np.rint(word_means(words, bundle.n_features, bundle.outcomes) * bundle.largest).astype(np.int64)
        difference = golden_violation(bundle.table[words], decider.scores_batch(numbers, 1))
        if difference:
            return [f"table and head disagree from word {int(words[0])} on: {difference}"]
    return []


def _bundle_alerts(bundle: Bundle) -> Iterator[str]:
    if bundle.analyser is not None:
        dark = np.flatnonzero(~bundle.analyser.matrix.any(axis=1))
        if len(dark):
            yield f"{len(dark)} of {bundle.n_features} detectors get no light (the first: {int(dark[0])})"
    elif (top := int(bundle.pattern_levels.max())) < bundle.levels - 1:
        yield f"the brightest pixel is at level {top} of {bundle.levels - 1}: every exposure is longer than it must be"
    dark = np.flatnonzero(~bundle.pattern_levels.any(axis=1))
    if len(dark) and bundle.analyser is None and bundle.automaton is None:  # a state may wait in the dark for its slot
        yield f"{len(dark)} of {bundle.n_patterns} patterns are dark (the first: {int(dark[0])}): exposures spent on nothing"
    if bundle.table is not None:
        yield from _never_decided(bundle, bundle.table)
    if bundle.automaton is not None:
        yield from _automaton_alerts(bundle, bundle.automaton)


def _automaton_alerts(bundle: Bundle, automaton: Automaton) -> Iterator[str]:
    unused = np.setdiff1d(np.arange(bundle.n_patterns), automaton.rows)
    if len(unused):
        yield f"{len(unused)} of {bundle.n_patterns} patterns are shown by no state (the first: {int(unused[0])})"
    longest = int(automaton.dwell.max())
    if longest < automaton.dwell_steps:
        yield f"the longest dwell is {longest} of {automaton.dwell_steps}: every exposure is longer than it must be"
    yield from _never_decided(bundle, automaton.posteriors[automaton.n_states :])


def _never_decided(bundle: Bundle, scores: NDArray[np.float32]) -> Iterator[str]:
    never = set(range(bundle.n_classes)) - set(np.unique(scores.argmax(axis=1)).tolist())
    if never:
        names = ", ".join(bundle.classes[label] for label in sorted(never)[:5])
        yield f"{len(never)} classes are never decided by any click word: {names}"


def _verify_recording(recording: Recording, verdict: FileVerdict) -> None:
    verdict.cut = not recording.complete
    if verdict.cut:
        verdict.violations.append(
            f"incomplete: no END block; {recording.end_offset} of {recording.size} bytes hold whole blocks, "
            f"with {recording.n_decisions} decisions"
        )
    n_classes = _verify_inner_bundle(recording, verdict)
    _verify_inner_profile(recording, verdict)
    first = first_decision(recording)
    verdict.violations += _decision_violations(recording, n_classes, first)
    verdict.violations += _timing_violations(recording, first + recording.n_decisions)
    for _ in recording.events():
        pass  # reading them is the check
    verdict.violations += _answer_violations(recording)
    streams = {"messages": recording.messages(), "commands": recording.commands(), "answers": recording.answers()}
    for stream, items in streams.items():
        place = _first_step_back(items)
        if place is not None:
            verdict.alerts.append(f"the host times of the {stream} go back at {place}")
    if recording.complete and recording.bundle_place and not verdict.violations:
        verdict.violations += replay_faults(recording, recording.bundle())


def _first_step_back(items: Iterator[tuple[int, bytes]]) -> int | None:
    """Return the place of the first item whose host time is less than the one before; all items are read."""
    before, found = -(1 << 63), None
    for place, (host_ns, _) in enumerate(items):
        if host_ns < before and found is None:
            found = place
        before = host_ns
    return found


def _answer_violations(recording: Recording) -> Iterator[str]:
    """What a host does not record as an answer; what the device wrote into a message of the right type is the device's matter."""
    for place, (_, body) in enumerate(recording.answers()):
        try:
            found = unpack_body(body).type
        except MalformedMessage as error:
            yield f"answer {place}: {error}"
            return
        if found not in ANSWER_TYPES:
            yield f"answer {place} is a message of type {found}, allowed: WELCOME, ACK, PONG"
            return


def _verify_inner_bundle(recording: Recording, verdict: FileVerdict) -> int:
    """Check the bundle inside; return its number of classes (the most there can be, if it is not there)."""
    if recording.bundle_place is None:
        verdict.alerts.append("the recording holds no bundle: it can only be replayed beside it")
        return NO_LABEL
    bundle = recording.bundle()
    inner = FileVerdict(verdict.path, "bundle")
    _verify_bundle(bundle, inner)
    verdict.violations += [f"the bundle inside: {text}" for text in inner.violations]
    verdict.alerts += [f"the bundle inside: {text}" for text in inner.alerts]
    return bundle.n_classes if bundle.picture_shape is None else 1  # a picture's label is 0


def _verify_inner_profile(recording: Recording, verdict: FileVerdict) -> None:
    text, profile = recording.profile_toml, recording.header.get("profile", {})
    if not text:
        verdict.alerts.append("the recording holds no hardware profile")
        return
    if hashlib.sha256(text.encode()).hexdigest() != profile.get("sha256"):
        verdict.violations.append("the hardware profile inside does not have the SHA-256 that stands beside it")
    try:
        parse_profile(text, "the profile inside")
    except ConfigError as error:
        verdict.violations.append(error.message)


def _decision_violations(recording: Recording, n_classes: int, first: int) -> Iterator[str]:
    """What no decision of ours can be, block by block."""
    found: dict[str, tuple[int, int]] = {}  # what is wrong -> the first such decision, how many there are
    place = 0
    for rows in recording.iter_decisions():
        for what, bad in _impossible(rows, n_classes, first + place).items():
            if bad.any():
                at, count = found.get(what, (place + int(np.argmax(bad)), 0))
                found[what] = at, count + int(bad.sum())
        place += len(rows)
    for what, (at, count) in found.items():
        yield f"decision {at} {what} ({count} of {place})"


def _impossible(decisions: NDArray[np.void], n_classes: int, first: int) -> dict[str, NDArray[np.bool_]]:
    """Which of these decisions, the first of which has the number `first`, break which rule."""
    known = DecisionFlag(0)
    for flag in DecisionFlag:
        known |= flag
    flags, labels, probability = decisions["flags"], decisions["label"], decisions["probability"]
    abstained = (flags & int(DecisionFlag.ABSTAINED)) != 0
    finite = np.isfinite(probability) & (probability >= 0) & (probability <= 1)
    return {
        "is not numbered in sequence": decisions["index"] != first + np.arange(len(decisions), dtype=np.uint64),
        "has flags that this version does not know": (flags & ~np.uint32(int(known))) != 0,
        "abstained, but has a label": abstained & (labels != NO_LABEL),
        f"has a label beyond the {n_classes} classes": ~abstained & (labels >= n_classes),
        "has a label despite a gap or a wrong pattern": ~abstained & ((flags & int(_ABSTAIN_CAUSES)) != 0),
        "has a probability outside [0, 1]": ~finite,
    }


def _timing_violations(recording: Recording, n_decisions: int) -> Iterator[str]:
    """What no timing of ours can be, block by block; of each kind the first."""
    found: dict[str, str] = {}
    before, place = -1, 0
    for rows in recording.iter_timings():
        indices = np.concatenate(([before], rows["index"].astype(np.int64)))
        if (np.diff(indices) <= 0).any():
            found.setdefault("order", "the timings are not in the order of the decisions")
        if len(rows) and (top := int(rows["index"].max())) >= n_decisions:
            found.setdefault("beyond", f"a timing belongs to decision {top}, but there are {n_decisions}")
        bad = (rows["decided_ns"] < rows["arrival_ns"]) | (rows["recorded_ns"] < rows["decided_ns"])
        if bad.any():
            words = "decided before it arrived, or recorded before it was decided"
            found.setdefault("times", f"timing {place + int(np.argmax(bad))}: {words}")
        before, place = int(indices[-1]), place + len(rows)
    yield from found.values()
