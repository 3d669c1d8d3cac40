"""Recordings, and labels from a CSV file, in; the clicks behind each decision with a known truth out.

Each recording is decided again, and its clicks are noted as the back end is asked. Decisions without trustworthy clicks (a gap, a wrong
pattern, changed dark counts) are left out. The file has lines `object,label`, or `recording,object,label` for several recordings; a label
is a class name of the bundle, or its number; an empty one leaves the object out.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import ConfigError, DamagedFileError, UsageError
from pans.base.files import read_file
from pans.bundle.sensor import Bundle
from pans.decide import Decision, DecisionFlag
from pans.record.reading import Recording, handshakes, is_of_parts, parts_in, read_recording
from pans.record.replay import ASKED, ClickLog, replay

HEADS = (("object", "label"), ("recording", "object", "label"))
ROWS_MAX = 1 << 20
BYTES_MAX = 1 << 26
OBJECT_MAX = (1 << 32) - 1
_LABELS_REMEDY = (
    "write one line `object,label` per object, the label a class name or its number, empty where it is unknown"
)
_TRUSTED = DecisionFlag.ABSTAINED | ASKED


class Labels(NamedTuple):
    """Labels by object; `by_recording` by the recording's file name, whose only key is "" where the file names none."""

    by_recording: Mapping[str, Mapping[int, int | None]]
    sha256: str

    @property
    def names_recordings(self) -> bool:
        """Whether each line names its recording."""
        return "" not in self.by_recording


def read_labels(path: Path, classes: Sequence[str]) -> Labels:
    """Return the labels in `path`; ConfigError, with the line, for a label out of range, an object twice, or another form."""
    data = read_file(path, BYTES_MAX)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8: {error}", remedy=_LABELS_REMEDY) from error
    rows = csv.reader(io.StringIO(text, newline=""))
    try:
        return Labels(_label_rows(path, rows, tuple(classes)), hashlib.sha256(data).hexdigest())
    except csv.Error as error:
        raise ConfigError(f"{path}:{rows.line_num}: no CSV: {error}", remedy=_LABELS_REMEDY) from error


def _label_rows(path: Path, rows: Any, classes: tuple[str, ...]) -> dict[str, dict[int, int | None]]:
    head = tuple(word.strip() for word in next(rows, []))
    if head not in HEADS:
        allowed = " or ".join(",".join(names) for names in HEADS)
        found = ascii(",".join(head))[:80]
        raise ConfigError(f"{path}:1: the first line is {found}, allowed: {allowed}", remedy=_LABELS_REMEDY)
    labels: dict[str, dict[int, int | None]] = {}
    for count, row in enumerate(rows):
        where = f"{path}:{rows.line_num}"
        if not row:
            continue
        if len(row) != len(head) or count >= ROWS_MAX:
            raise ConfigError(f"{where}: {len(row)} values, allowed: {len(head)}, in at most {ROWS_MAX} lines")
        recording, number, label = (word.strip() for word in (["", *row][-3:]))
        object_id = _whole(number, OBJECT_MAX)
        if object_id is None:
            raise ConfigError(f"{where}: the object is {ascii(number)[:40]}, allowed: whole numbers 0 to {OBJECT_MAX}")
        mine = labels.setdefault(recording, {})
        if object_id in mine:
            raise ConfigError(f"{where}: object {object_id} has a label already", remedy="name each object once")
        mine[object_id] = classes.index(label) if label in classes else _whole(label, len(classes) - 1)
        if mine[object_id] is None and label:
            names = ", ".join(classes[:10]) + (", ..." if len(classes) > 10 else "")
            raise ConfigError(
                f"{where}: the label is {ascii(label)[:40]}, allowed: 0 to {len(classes) - 1}, or one of {names}",
                remedy="name a class of the bundle (pans info BUNDLE lists them)",
            )
    if not any(label is not None for mine in labels.values() for label in mine.values()):
        raise ConfigError(f"{path}: no object has a label", remedy=_LABELS_REMEDY)
    return labels


def _whole(word: str, most: int) -> int | None:
    """Return a whole number from 0 to `most`; None for any other text."""
    return int(word) if word.isascii() and word.isdigit() and len(word) <= 10 and int(word) <= most else None


@dataclass(frozen=True, slots=True, eq=False)
class Labelled:
    """Decisions with a known truth, of all recordings; `left_out` counts the others by why."""

    counts: NDArray[np.int64]  # (n, d_f): clicks per pattern, or of a walk its click word
    truth: NDArray[np.int64]  # (n,)
    object_id: NDArray[np.int64]  # (n,): the object; the same number in two decisions is the same object
    shots: int
    sources: tuple[dict[str, Any], ...]  # of the provenance: name, SHA-256 and decisions of each recording
    simulated: bool
    left_out: dict[str, int]
    photons: float | None  # means per decision of the summaries, None where they do not know
    illumination: float | None


class _Read(NamedTuple):
    path: Path
    sha256: str
    recording: Recording
    log: ClickLog
    cycle: int  # objects after which the scene starts over; 0: never, or it is not known
    scene: str  # of that many objects; recordings of one scene show the same ones

    def place(self, decision: Decision) -> int:
        """Return the object's number in its scene."""
        return decision.object % self.cycle if self.cycle else decision.object


def labelled_clicks(
    bundle: Bundle, bundle_sha256: str, paths: Sequence[Path], labels: Labels | None, cycle: int = 0
) -> Labelled:
    """Return the labelled decisions in recordings of `bundle`, files or folders of parts; truths are those of `labels`, or the marks'.

    `cycle` says after how many objects the scene starts over: object k and k + cycle are one. A simulated scene says it itself. UsageError
    for recordings of another bundle, of moving objects, twice the same one, or without a label; DamagedFileError for damage.
    """
    files = [part for path in paths for part in (parts_in(path) if is_of_parts(path) else [path])]
    read = [_read(path, bundle, bundle_sha256, cycle) for path in files]
    for place, one in enumerate(read):
        if (before := next((other for other in read[:place] if other.sha256 == one.sha256), None)) is not None:
            raise UsageError(f"{one.path}: the same recording as {before.path}", remedy="name each recording once")
    shots = {one.log.shots for one in read if one.log.counts}
    if len(shots) > 1:
        raise UsageError(f"recordings with {sorted(shots)} shots per decision", remedy="refit each --shots by itself")
    labels_of = {} if labels is None else _labels_of(labels, read)
    truths, object_ids, counts, sources = list[int](), list[int](), [], []
    numbers: dict[tuple[str, int], int] = {}
    truth_of: dict[int, int] = {}
    left_out = {"without a label": 0, "not trusted": 0}
    for one in read:
        scene = one.scene if one.cycle and not (labels and labels.names_recordings) else one.sha256
        begin = len(truths)
        for words, decision in zip(one.log.counts, one.log.decisions, strict=True):
            place = one.place(decision)
            truth = decision.truth if labels is None else labels_of[one.path].get(place)
            if decision.flags & ~int(_TRUSTED):
                left_out["not trusted"] += 1
            elif truth is None or truth < 0:
                left_out["without a label"] += 1
            else:
                number = numbers.setdefault((scene, place), len(numbers))
                if truth_of.setdefault(number, truth) != truth:
                    raise UsageError(
                        f"object {place} is once of class {truth_of[number]}, once of class {truth}",
                        remedy="correct the labels, or --cycle: after how many objects the scene starts over",
                    )
                counts.append(words)
                truths.append(truth)
                object_ids.append(number)
        sources.append({"name": one.path.name, "sha256": one.sha256, "decisions": len(truths) - begin})
    if not truths:
        raise UsageError(
            "no decision has a label" + "".join(f", {n} are {why}" for why, n in left_out.items() if n),
            remedy="name the objects' classes with --labels FILE.csv (a simulated scene with labels names them itself)",
        )
    return Labelled(
        np.stack(counts),
        np.array(truths),
        np.array(object_ids),
        read[0].log.shots,
        tuple(sources),
        any(one.recording.simulated for one in read),
        left_out,
        _mean(read, "photons_mean"),
        _mean(read, "illumination_mean", "illumination"),
    )


def _read(path: Path, bundle: Bundle, bundle_sha256: str, cycle: int) -> _Read:
    recording = read_recording(path)
    found = recording.header.get("bundle_sha256")
    if found != bundle_sha256:
        raise UsageError(
            f"{path}: recorded with another bundle (SHA-256 {ascii(found)[1:13]}..., {bundle.name} has {bundle_sha256[:12]}...)",
            remedy="refit the bundle that the recording was made with",
        )
    config = recording.header.get("config")
    if isinstance(config, dict) and ("flow" in config or config.get("confidence") or config.get("walk_dose")):
        what = "objects flow past" if "flow" in config else "walks end early (--confidence, --dose-cap)"
        remedy = "record objects that stand still, without --confidence and --dose-cap"
        raise UsageError(f"{path}: {what} in this run", remedy=remedy)
    log = ClickLog()
    if not replay(recording, bundle, log).as_recorded or len(log.counts) != len(log.decisions):
        remedy = "see `pans replay` and `pans verify`"
        raise DamagedFileError(f"{path}: its clicks do not give its decisions again", remedy=remedy)
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    if cycle:
        return _Read(path, sha256, recording, log, cycle, "")
    facts: dict[str, Any] = next((row["device"] for row in handshakes(recording) if row["device"]), {})
    objects = facts.get("objects", 0)
    if not isinstance(objects, int) or objects < 1:
        return _Read(path, sha256, recording, log, 0, "")
    return _Read(path, sha256, recording, log, objects, str(facts.get("scene", "")))


def _labels_of(labels: Labels, read: Sequence[_Read]) -> dict[Path, Mapping[int, int | None]]:
    """Return the labels of each recording; UsageError unless each belongs to an object that was recorded, and they name all."""
    if labels.names_recordings:
        names = [one.path.name for one in read]
        for name in labels.by_recording:
            if names.count(name) != 1:
                raise UsageError(
                    f"labels of {ascii(name)[:60]}, which {names.count(name)} of the recordings are called"
                )
        for one in read:
            if one.path.name not in labels.by_recording:
                raise UsageError(f"{one.path}: no labels for this recording", remedy="label it, or leave it out")
        groups = [(str(one.path), labels.by_recording[one.path.name], [one]) for one in read]
    else:
        if len(read) > 1 and not all(one.cycle for one in read):
            raise UsageError(
                f"labels by object alone for {len(read)} recordings",
                remedy="add a column `recording` with the file's name, or say with --cycle after how many objects the scene starts over",
            )
        groups = [("the recordings", labels.by_recording[""], list(read))]
    for where, mine, some in groups:
        recorded = {one.place(decision) for one in some for decision in one.log.decisions}
        if unknown := sorted(mine.keys() - recorded):
            raise UsageError(
                f"labels for {len(unknown)} objects that {where} do not have, object {unknown[0]} first",
                remedy="number the objects from 0 in the order in which they passed",
            )
        if len(some) == 1 and (missing := sorted(recorded - mine.keys())):
            raise UsageError(
                f"{some[0].path}: {len(missing)} objects are not in the labels, object {missing[0]} first",
                remedy="add their lines, with an empty label where it is unknown: those are left out",
            )
    return {one.path: mine for _, mine, some in groups for one in some}


def _mean(read: Sequence[_Read], *names: str) -> float | None:
    """The mean over the decisions of the first of `names` that each summary has, None where one has none."""
    found = [
        next((s[name] for name in names if s.get(name) is not None), None)
        for s in (one.recording.summary for one in read)
    ]
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in found):
        return None
    return float(np.average(np.array(found, np.float64), weights=[len(one.log.counts) for one in read]))
