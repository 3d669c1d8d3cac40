"""Recordings in parts, `run-0001.pansrec` and so on for `run.pansrec`: their names, the chain from one to the next, all as one recording.

`chain_violations` says what is wrong between parts; a beginning that the run deleted itself is no fault, a hole is.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from glob import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

from pans.base.errors import DamagedFileError, UsageError, refusing
from pans.base.files import Block
from pans.bundle.sensor import Bundle
from pans.decide import Place

from .format import PART_EVENT, Kind
from .recording import Recording, read_recording

REPEATED = frozenset((Kind.HEADER, Kind.BUNDLE))  # in each part


def part_path(first: Path, number: int) -> Path:
    """Return the path of part `number`: `run.pansrec` becomes `run-0001.pansrec`."""
    return first.with_name(f"{first.stem}-{number:04d}{first.suffix}")


def part_number(path: Path) -> int | None:
    """Return the number in the name of a part: 12 for `run-0012.pansrec`; None for other names."""
    found = re.fullmatch(r".*-(\d{1,10})", path.stem, re.ASCII)  # the index of a block is a u32, and a part has several
    return None if found is None else int(found[1])


def stem_of(path: Path) -> str:
    """Return what the parts of one run have in common: `run` for `run-0012.pansrec`."""
    return path.stem.rpartition("-")[0]


def chained(chain_sha256: str, decisions_sha256: str) -> str:
    """Return the hash over all parts' logs so far: SHA-256 of the one before ("" at first) and this part's, as hex texts."""
    return hashlib.sha256(f"{chain_sha256}{decisions_sha256}".encode("ascii")).hexdigest()


def find_parts(place: str | Path) -> list[Path]:
    """Return the parts in the folder `place`, or those of the recording `place`, in order."""
    folder, stem = Path(place), "*"
    if not folder.is_dir():
        folder, stem = folder.parent, escape(folder.stem)
    found = [path for path in folder.glob(f"{stem}-[0-9]*.pansrec") if part_number(path) is not None]
    return sorted(found, key=lambda path: (stem_of(path), part_number(path)))


def is_of_parts(path: str | Path) -> bool:
    """Say whether `path` stands for a recording in parts: a folder, or the name of a recording of which only parts are there."""
    return Path(path).is_dir() or (not Path(path).exists() and bool(find_parts(path)))


def parts_in(place: str | Path) -> list[Path]:
    """As `find_parts`; UsageError if there are none."""
    if paths := find_parts(place):
        return paths
    raise UsageError(f"{place}: no parts of a recording are here", remedy="parts are named like run-0001.pansrec")


def files_of_parts(first: Path) -> list[Path]:
    """Return the parts of the recording `first`, and those that were made ahead and never begun: a later run replaces them."""
    stem, suffix = re.escape(first.stem), re.escape(first.suffix)
    wanted = re.compile(rf"{stem}-\d{{4,}}{suffix}|\.{stem}-\d{{4,}}{suffix}\.[0-9a-f]+\.partial")
    with refusing(f"{first.parent}: cannot be read"), suppress(FileNotFoundError):
        return [first.with_name(name) for name in sorted(os.listdir(first.parent)) if wanted.fullmatch(name)]
    return []


# ---- the chain ----


def part_of(recording: Recording) -> Mapping[str, Any] | None:
    """Return how this part begins (number, first decision, what was before, place of the core), None for a recording that is whole.

    None too for a part that a power cut left with its name and header alone: it holds nothing that could begin anywhere.
    DamagedFileError if it says that it is a part and does not say where it begins.
    """
    if "part" not in recording.header:
        return None
    event = next(recording.events(), None)
    if event is None and not recording.complete and not {Kind.MESSAGES, Kind.DECISIONS} & recording.kinds.keys():
        return None
    if event is None or event.get("kind") != PART_EVENT or not isinstance(event.get("place"), dict):
        raise DamagedFileError(f"{recording.path}: a part of a run that does not say where it begins")
    return event


def place_of(recording: Recording) -> Place | None:
    """Return the core's place at the beginning of a later part; None where the run itself begins. Errors as of `part_of`."""
    part = part_of(recording)
    try:
        return None if part is None or part["number"] == 1 else Place.of(part["place"])
    except (LookupError, TypeError, ValueError) as error:
        raise DamagedFileError(f"{recording.path}: the place where it begins cannot be read: {error}") from error


def first_decision(recording: Recording) -> int:
    """Return the number of the first decision: 0 but in a later part."""
    part = part_of(recording)
    return 0 if part is None else int(part["first_decision"])


def earlier_parts(recording: Recording) -> str:
    """Return in words which parts of the run come before `recording` and what was in them, "" where the run itself begins."""
    part = part_of(recording)
    if part is None or part["number"] == 1:
        return ""
    before, decisions = int(part["number"]) - 1, int(part["first_decision"])
    each = recording.parts if isinstance(recording, JoinedRecording) else ()
    deleted = max([int((one.get("deleted") or {}).get("parts", 0)) for _, one in _known(each)], default=0)
    which = f"parts 1 to {before}" if before > 1 else "part 1"
    how = "not read" if not each else "deleted by the run" if deleted >= before else "missing"
    return f"{which} of the run, with the decisions before number {decisions}: {how}"


def chain_violations(recordings: Sequence[Recording]) -> list[str]:
    """Return what is wrong between parts that should follow each other; verify.py checks each by itself."""
    known = _known(recordings)
    violations = [f"{one.path}: not a part" for one in recordings if "part" not in one.header]
    if len(runs := {recording.header["part"].get("run") for recording, _ in known}) > 1:
        violations.append(f"parts of {len(runs)} runs are in one folder")
    for recording, part in known:
        if part["number"] != part_number(recording.path):
            violations.append(f"{recording.path.name}: it is part {part['number']} of its run: it was renamed")
    for (earlier, first), (later, second) in pairwise(known):
        where = later.path.name
        if second["number"] != first["number"] + 1:
            violations.append(
                f"{where}: part {second['number']} follows part {first['number']}: one is missing between"
            )
            continue
        before = second.get("before") or {}
        chain_before = str((first.get("before") or {}).get("chain_sha256", ""))
        expected = {
            "first_decision": first["first_decision"],
            "decisions": earlier.n_decisions,
            "decisions_sha256": earlier.decisions_sha256,
            "chain_sha256": chained(chain_before, earlier.decisions_sha256),
        }
        for key in (key for key in expected if before.get(key) != expected[key]):
            said = f"{key} {ascii(before.get(key))[:80]}, found {expected[key]}"
            violations.append(f"{where}: it says that the part before has {said}")
        if second["first_decision"] != first["first_decision"] + earlier.n_decisions:
            violations.append(f"{where}: it begins with decision {second['first_decision']}, which does not follow")
    return violations


def missing_parts(recordings: Sequence[Recording]) -> Iterator[str]:
    """Yield what is missing at the beginning and at the end of one run's parts, and what is there although the run had ended."""
    known = _known(recordings)
    for place, (recording, _) in enumerate(known):
        following = recording.summary.get("next") if "part_ended" in recording.summary else None
        is_last = place + 1 == len(known)
        if following is not None and is_last:
            yield f"{ascii(following)[1:81].rstrip(chr(39))} is missing: {recording.path.name} continues in it"
        if recording.complete and following is None and not is_last:
            yield f"{known[place + 1][0].path.name} is surplus: the run ended with {recording.path.name}"
    for recording, part in known[:1]:
        gone = max(int((one.get("deleted") or {}).get("parts", 0)) for _, one in known)
        first = recording.path.with_name(f"{stem_of(recording.path)}{recording.path.suffix}")
        for number in range(gone + 1, int(part["number"])):
            yield f"{part_path(first, number).name} is missing: the run did not delete it"


def _known(recordings: Sequence[Recording]) -> list[tuple[Recording, Mapping[str, Any]]]:
    """Return the parts that say where they begin, each with how."""
    return [(recording, part) for recording in recordings if (part := part_of(recording)) is not None]


# ---- a run in parts as one recording ----


@dataclass(frozen=True, slots=True, repr=False)
class JoinedRecording(Recording):
    """The parts of a run, read one after the other; the bundle, which each part repeats, is that of the first. Plan and ARM,
    which they repeat too, come again in `commands`, where repetitions change nothing.

    `path` is what was opened, `decisions_sha256` the chain over the parts' logs, `summary` that of the last part. A `Block` of
    `iter_blocks` has its index within its part.
    """

    parts: tuple[Recording, ...]

    def iter_blocks(self, *wanted: Kind) -> Iterator[Block]:
        """Yield the whole blocks of these kinds, part by part; header and bundle of the first one alone."""
        for number, part in enumerate(self.parts):
            once = REPEATED if number else frozenset()
            yield from (block for block in part.iter_blocks(*wanted) if block.kind not in once)

    def read(self, *wanted: Kind) -> Iterator[tuple[Kind, Any]]:
        """Yield the kind and the content of each whole block of these kinds, part by part."""
        return (one for part in self.parts for one in part.read(*wanted))

    def bundle(self) -> Bundle:
        """Return the bundle that the run used; UsageError if it was not recorded."""
        return self.parts[0].bundle()


def open_recording(path: str | Path, *, salvage: bool = False) -> Recording:
    """Return the recording that `path` stands for: a file, the parts of a run (their folder or index) as one, or a run's folder.

    Errors as of `read_recording`; DamagedFileError too for parts that do not follow each other (with `salvage` it is the damage).
    """
    if not is_of_parts(path):
        return read_recording(path, salvage=salvage)
    if not (paths := find_parts(path)):
        return read_recording(_only_recording(Path(path)), salvage=salvage)
    parts = tuple(read_recording(one, salvage=salvage) for one in paths)
    broken = chain_violations(list(parts))
    if broken and not salvage:
        raise DamagedFileError(
            f"{path}: {broken[0]}", remedy="`pans verify` lists everything; each part can be read by itself"
        )
    return _joined(Path(path), parts, broken)


def _only_recording(folder: Path) -> Path:
    """Return the one recording of a run's folder."""
    found = sorted(folder.glob("*.pansrec"))
    if len(found) != 1:
        names = ", ".join(path.name for path in found[:5]) or "none"
        raise UsageError(f"{folder}: {len(found)} recordings are here ({names})", remedy="name one recording")
    return found[0]


def _joined(path: Path, parts: tuple[Recording, ...], broken: list[str]) -> JoinedRecording:
    first, last, chain = parts[0], parts[-1], ""
    for part in parts:
        chain = chained(chain, part.decisions_sha256)
    return JoinedRecording(
        path=path,
        size=sum(part.size for part in parts),
        header=first.header,
        kinds=sum((Counter(part.kinds) for part in parts), Counter()),
        n_decisions=sum(part.n_decisions for part in parts),
        decisions_sha256=chain,
        complete=all(part.complete for part in parts),
        end_offset=last.end_offset,
        summary=last.summary,
        damage="; ".join([*(part.damage for part in parts if part.damage), *broken]),
        bundle_place=first.bundle_place,
        parts=parts,
    )
