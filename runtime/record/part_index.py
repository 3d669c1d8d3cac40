"""The index beside the parts of a recording, read back: which parts there must be, and what is missing, surplus or another run's.

Owns what the index promises; its form is part_keeper.py's, the chain from part to part is parts.py's. `compare_with_index` never raises for
what the index holds. The index is written when a part has been closed, so a run that was killed has parts behind the last indexed one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pans.runtime.container import parse_json_object, read_file
from pans.runtime.errors import DamagedFileError

from .part_keeper import INDEX_FORMAT, INDEX_SUFFIX
from .parts import part_number, part_of
from .recording import Recording

INDEX_MAX_BYTES = 1 << 28
CLOSED_UNINDEXED = (
    1  # parts that a kill may leave closed and not in the index: one thread closes a part, then writes the index
)
_PART_KEYS = {
    "name": str,
    "bytes": int,
    "first_decision": int,
    "decisions": int,
    "decisions_sha256": str,
    "chain_sha256": str,
}


@dataclass(slots=True)
class IndexFindings:
    """What is wrong between an index and the files beside it."""

    violations: list[str] = field(default_factory=list)
    alerts: list[str] = field(default_factory=list)


def read_index(path: Path) -> dict[str, Any]:
    """Return the index at `path`; DamagedFileError if it is none."""
    index = parse_json_object(read_file(path, INDEX_MAX_BYTES), str(path))
    deleted, parts = index.get("deleted"), index.get("parts")
    fits = (
        index.get("format") == INDEX_FORMAT
        and isinstance(index.get("run"), str)
        and isinstance(deleted, dict)
        and all(_is_count(deleted.get(key)) for key in ("parts", "bytes", "decisions"))
        and isinstance(parts, list)
        and all(_is_entry(entry) for entry in parts)
    )
    if not fits:
        raise DamagedFileError(f"{path}: not an index of the form {INDEX_FORMAT!r}")
    return index


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_entry(entry: Any) -> bool:
    if not isinstance(entry, dict):
        return False
    fits = (
        _is_count(entry.get(key)) if kind is int else isinstance(entry.get(key), kind)
        for key, kind in _PART_KEYS.items()
    )
    return all(fits) and part_number(Path(entry["name"])) is not None and Path(entry["name"]).name == entry["name"]


def compare_with_index(place: Path, stem: str, paths: Sequence[Path], whole: Mapping[str, Recording]) -> IndexFindings:
    """Compare the parts at `paths`, all of one `stem` in the folder `place`, with their index.

    `whole` are those that can be read, by name.
    """
    findings = IndexFindings()
    names = [path.name for path in paths]
    index_file = place / f"{stem}{INDEX_SUFFIX}"
    index: dict[str, Any] | None = None
    if index_file.exists():
        try:
            index = read_index(index_file)
        except DamagedFileError as error:
            findings.violations.append(error.message)
    elif sum(recording.complete for recording in whole.values()) > CLOSED_UNINDEXED:
        findings.alerts.append(
            f"{index_file.name} is missing: it cannot be said whether parts were deleted at the beginning"
        )
    if index is not None:
        findings.violations += _missing(index, names)
        findings.violations += _contradictions(index, whole)
        for name in names:
            _judge_surplus(name, index, findings)
    findings.violations += _cut_ends(names, whole, index)
    return findings


def _missing(index: Mapping[str, Any], names: Sequence[str]) -> Iterator[str]:
    for entry in index["parts"]:
        if entry["name"] not in names:
            yield f"{entry['name']} is missing: the index has it with {entry['decisions']} decisions, {entry['bytes']} bytes"


def _contradictions(index: Mapping[str, Any], whole: Mapping[str, Recording]) -> Iterator[str]:
    """What an indexed part, or the index itself, does not hold of what the index says."""
    for number, entry in enumerate(index["parts"], index["deleted"]["parts"] + 1):
        if part_number(Path(entry["name"])) != number:
            yield f"the index has {entry['name']} as part {number}"
        recording = whole.get(entry["name"])
        if recording is None:
            continue
        found = {
            "bytes": recording.size,
            "decisions": recording.n_decisions,
            "decisions_sha256": recording.decisions_sha256,
        }
        for key, value in found.items():
            if entry[key] != value:
                yield f"{entry['name']}: the index says {key} = {ascii(entry[key])[:80]}, found {value}"
    for name, recording in whole.items():
        run = recording.header.get("part", {}).get("run")
        if run != index["run"]:
            yield f"{name} is of run {ascii(run)[:40]}, the index of run {ascii(index['run'])[:40]}"


def _judge_surplus(name: str, index: Mapping[str, Any], findings: IndexFindings) -> None:
    """A part that the index lacks: deleted by its word, or in the middle. Those behind the last one are the chain's matter."""
    indexed = [entry["name"] for entry in index["parts"]]
    number, deleted = part_number(Path(name)) or 0, index["deleted"]["parts"]
    if name in indexed:
        return
    if number <= deleted:
        findings.alerts.append(f"{name} is surplus: the index says that parts 1 to {deleted} were deleted")
    elif number <= deleted + len(indexed):
        findings.violations.append(f"{name} is surplus: it is not in the index")


def _cut_ends(names: Sequence[str], whole: Mapping[str, Recording], index: Mapping[str, Any] | None) -> Iterator[str]:
    """Parts that end with "full" name the next one; a part that does not is the last one."""
    for place, name in enumerate(names):
        recording = whole.get(name)
        if recording is None or not recording.complete:
            continue
        following = recording.summary.get("next") if "part_ended" in recording.summary else None
        is_last = place + 1 == len(names)
        if following is not None and is_last and not _named(index, following):
            yield f"{ascii(following)[:80]} is missing: {name} goes on in it"
        if following is None and not is_last:
            yield f"{names[place + 1]} is surplus: the run ended with {name}"
    first = next((whole[name] for name in names if name in whole), None)
    if index is None and first is not None and (part := part_of(first)) is not None and part["number"] > 1:
        yield f"the run begins with part {part['number']}, and no index says that those before it were deleted"


def _named(index: Mapping[str, Any] | None, name: Any) -> bool:
    """Whether the index has the part, so that it has been reported already."""
    return index is not None and any(entry["name"] == name for entry in index["parts"])
