"""`pans runs`: list what lies in a folder of runs (date, bundle, verdict, decisions, size), and prune it.

No file is deleted that no run of pans has written, and none of a run that is under way. A recording is read as far as it is needed: its
header, the headers of its blocks, and its END, which `read_recording` would check against all bytes.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from pans.app.command import Command
from pans.base.console import emit, one_line, refuse_without, warn
from pans.base.errors import EXIT_ALERT, EXIT_FINE, PansError, UsageError
from pans.base.files import (
    FILE_PROLOGUE,
    LATEST,
    RUNS,
    check_prologue,
    last_block,
    lock_is_held,
    locked,
    open_regular,
    parse_json_object,
    read_block,
)
from pans.base.numbers import Range
from pans.decide import is_judged
from pans.record.reading import FORMAT_VERSION, LIMITS, MAGIC, Kind, checked_summary, part_number, skim_decisions

OURS = re.compile(r"[^/]*\.pansrec|(?:.*\.)?summary\.(?:md|json)|\..*\.(?:lock|partial|next|probe)|\.pans-run\.lock")
RUN_LOCK = ".pans-run.lock"
LOG_MAX_BYTES = 1 << 26  # of a run that was cut, in whose decision log it is looked how far it went
KEEP = Range(0, 1_000_000, whole=True)
_TIMES = {"s": 1, "min": 60, "h": 3600, "d": 86400, "w": 7 * 86400, "y": 365 * 86400}
_SIZES = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
_QUANTITY = re.compile(r"(\d{1,12}(?:\.\d{1,6})?)\s?([A-Za-z]+)")


@dataclass(frozen=True, slots=True)
class Run:
    """One folder with a recording; what is not known is "" or None."""

    folder: Path
    started: datetime
    bundle: str
    verdict: str  # PASS, FAIL, "running", or "cut" without an END
    decisions: int | None
    judged: int | None  # of which `accuracy` is
    accuracy: float | None
    dark_per_exposure: float | None  # clicks per dark exposure
    bytes: int  # of the run's own files
    simulated: bool
    locked: bool
    command: str  # the command line
    faults: tuple[str, ...]
    files: tuple[Path, ...] = field(repr=False)
    summary: Mapping[str, Any] = field(repr=False, default_factory=dict)

    @property
    def in_parts(self) -> bool:
        """Whether every recording is a part."""
        return all(part_number(path) is not None for path in self.files if path.suffix == ".pansrec")

    def as_json(self) -> dict[str, Any]:
        """Return the facts but for files and summary, JSON-able."""
        facts = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in ("files", "summary")}
        return facts | {"folder": str(self.folder), "started": self.started.isoformat(timespec="seconds")}


def runs_in(root: Path) -> list[Run]:
    """Return the runs in `root` and, if it is one itself, in it; the newest first. UsageError for a folder that cannot be read."""
    try:
        inside = [path for path in root.iterdir() if path.is_dir() and not path.is_symlink()]
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"{root}: cannot be read: {reason}", remedy="name a folder of runs") from error
    found = [run for folder in (root, *inside) if (run := run_of(folder)) is not None]
    return sorted(found, key=lambda run: (run.started, run.folder.name), reverse=True)


def run_of(folder: Path) -> Run | None:
    """Return the run in `folder`, None if there is no recording in it."""
    try:
        entries = sorted(path for path in folder.iterdir() if path.is_file() and not path.is_symlink())
    except OSError:
        return None
    recordings = [path for path in entries if path.suffix == ".pansrec"]
    if not recordings:
        return None
    files = tuple(path for path in entries if OURS.fullmatch(path.name))
    (header, bundle), summary = _begin(recordings[0]), _end(recordings[-1])
    dark, faults = summary.get("dark"), summary.get("faults")
    dark = dark if isinstance(dark, dict) and dark.get("exposures") else {}
    started = datetime.fromtimestamp(recordings[0].stat().st_mtime, UTC)
    with suppress(ValueError):
        started = datetime.fromisoformat(str(header.get("created_utc", "")))
    is_locked = lock_is_held(folder / RUN_LOCK)
    far = summary if summary or is_locked else _as_far_as(recordings)
    return Run(
        folder=folder,
        started=started if started.tzinfo else started.replace(tzinfo=UTC),
        bundle=bundle or str(header.get("bundle_sha256", ""))[:12],
        verdict="running" if is_locked else str(summary.get("verdict", "cut"))[:20],
        decisions=_number(far.get("decisions")),
        judged=_number(far.get("judged")),
        accuracy=_number(far.get("accuracy")),
        dark_per_exposure=_number(dark.get("per_exposure")),
        bytes=sum(path.stat().st_size for path in files),
        simulated=bool(header.get("simulated") or summary.get("simulated")),
        locked=is_locked,
        command=str(header.get("command", "")),
        faults=tuple(map(str, faults)) if isinstance(faults, list) else (),
        files=files,
        summary=summary,
    )


def _begin(path: Path) -> tuple[dict[str, Any], str]:
    """Return a recording's header and the name of the bundle inside, {} and "" if they cannot be read."""
    header: dict[str, Any] = {}
    with suppress(PansError, OSError), open_regular(path) as file:
        chain = check_prologue(file.read(FILE_PROLOGUE.size), MAGIC, FORMAT_VERSION, str(path))
        for number in range(2):
            block = read_block(file, number, chain, LIMITS, str(path))
            if block is not None and block.kind == Kind.HEADER:
                header, chain = parse_json_object(block.payload, str(path)), block.chain
            elif block is not None and block.kind == Kind.BUNDLE:
                start = block.payload.find(b"{", 0, 256)  # nothing else of the bundle is read
                return header, str(_object_at(block.payload[: start + (1 << 20)], start).get("name", ""))[:100]
    return header, ""


def _end(path: Path) -> dict[str, Any]:
    """Return the summary of the END that a recording ends with, {} without one; the payloads before it are not checked."""
    with suppress(PansError, OSError), open_regular(path) as file:
        where = str(path)
        chain = check_prologue(file.read(FILE_PROLOGUE.size), MAGIC, FORMAT_VERSION, where)
        if (block := last_block(file, Kind.END, chain, LIMITS, where)) is not None:
            return checked_summary(parse_json_object(block.payload, where).get("summary"), where)
    return {}


def _as_far_as(recordings: Sequence[Path]) -> dict[str, Any]:
    """Return decisions and accuracy of a run that was cut, from its decision log alone; {} of a large one, and without any."""
    sums = np.zeros(3, np.int64)
    for rows in skim_decisions(recordings, LOG_MAX_BYTES):
        judged = is_judged(rows)
        right = judged & (rows["label"] == rows["truth"])
        sums += len(rows), int(judged.sum()), int(right.sum())
    decisions, known, right = sums.tolist()
    found = {"decisions": decisions, "judged": known, "accuracy": right / known if known else None}
    return found if decisions else {}


def _object_at(data: bytes, start: int) -> dict[str, Any]:
    """The JSON object that begins at `start` (-1: none), {} where there is none."""
    with suppress(ValueError, RecursionError):
        found, _ = json.JSONDecoder().raw_decode(data[start:].decode("ascii", "replace"))
        return found if isinstance(found, dict) else {}
    return {}


def _number(value: Any) -> Any:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


# ---- which may go ----


def prunable(
    runs: Sequence[Run], *, older_s: float | None, larger: int | None, keep: int, now: float | None = None
) -> list[Run]:
    """Return the runs, oldest last, that are older than `older_s` and larger than `larger` bytes (None: whatever that is).

    The `keep` newest ones stay, and so does every run that has not ended.
    """
    at = time.time() if now is None else now
    return [
        run
        for run in sorted(runs, key=lambda run: run.started, reverse=True)[keep:]
        if not run.locked
        and (older_s is None or at - run.started.timestamp() > older_s)
        and (larger is None or run.bytes > larger)
    ]


def delete_run(run: Run) -> Iterator[str]:
    """Delete the files of `run`, and its folder if nothing else is in it; yield what stays and why. UsageError if it began to run."""
    lock = run.folder / RUN_LOCK
    with locked(lock):
        for path in run.files:
            if path == lock:
                continue
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                yield f"{path}: {error.strerror or error}"
    try:
        run.folder.rmdir()
    except OSError:
        rest = sorted(path.name for path in run.folder.iterdir())
        yield f"{run.folder}: kept, as other files are in it: {', '.join(rest[:5])}"


def make_room(root: Path, command: str, most: int) -> Iterator[str]:
    """Delete the oldest runs in `root` so that those that stay have at most `most` bytes together; yield what was done, and what stays.

    Runs of another command line, of which the recording is not in parts, or that have not ended do not count and stay.
    """
    ours = [run for run in runs_in(root) if run.command == command and not run.locked and run.in_parts]
    sizes = accumulate(run.bytes for run in ours)  # the newest first
    for run in [run for run, size in zip(ours, sizes) if size > most][::-1]:
        try:
            yield from delete_run(run)
            yield f"{run.folder}: {_size(run.bytes)} deleted"
        except UsageError as error:  # it began to run since it was listed
            yield error.message


# ---- the command ----


def _quantity(text: str, units: dict[str, int], example: str) -> float:
    found = _QUANTITY.fullmatch(text.strip())
    if found is None or found[2] not in units:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number with one of {', '.join(units)}, such as {example}")
    return float(found[1]) * units[found[2]]


def duration_s(text: str) -> float:
    """Return the seconds of a text such as `30d` or `12h`."""
    return _quantity(text, _TIMES, "30d")


def size_bytes(text: str) -> int:
    """Return the bytes of a text such as `5GB` or `200MiB`."""
    return round(_quantity(text, _SIZES, "5GB"))


def _configure(parser: argparse.ArgumentParser) -> None:
    what = f"list or prune this folder (default {RUNS})"
    parser.add_argument("what", nargs="*", metavar="[prune] [FOLDER]", help=what)
    group = parser.add_argument_group("prune: which runs go; all that is given must hold")
    group.add_argument("--older-than", type=duration_s, metavar="TIME", help="begun longer ago than that: 30d, 12h, 2w")
    group.add_argument("--larger-than", type=size_bytes, metavar="SIZE", help="larger than that: 5GB, 200MB")
    group.add_argument("--keep", type=KEEP.option, metavar="N", help="keep the N newest runs, whatever they are")
    group.add_argument("--yes", action="store_true", help="delete them; without it they are only listed")


def _run(args: argparse.Namespace) -> int:
    prunes = args.what[:1] == ["prune"]
    rest = args.what[1:] if prunes else args.what
    if len(rest) > 1:
        raise UsageError(f"found {len(rest)} folders, allowed: one", remedy="pans runs [prune] [FOLDER]")
    folder = Path(rest[0]) if rest else RUNS
    if prunes:
        return _prune(args, folder)
    refuse_without(args, "prune", {"older_than": None, "larger_than": None, "keep": None, "yes": False})
    runs, latest = runs_in(folder), folder / LATEST
    total = sum(run.bytes for run in runs)
    named = {"folder": str(folder), "latest": str(latest.resolve()) if latest.is_symlink() else None}
    payload = named | {"bytes": total, "runs": [run.as_json() for run in runs]}
    emit(args, payload, "\n".join([*_table(runs), f"{len(runs)} runs, {_size(total)} in {folder}"]))
    return EXIT_FINE


def _prune(args: argparse.Namespace, folder: Path) -> int:
    if args.older_than is None and args.larger_than is None and args.keep is None:
        remedy = "give --older-than, --larger-than or --keep"
        raise UsageError("`pans runs prune` needs to know which runs may go", remedy=remedy)
    runs, stays = runs_in(folder), list[str]()
    going = prunable(runs, older_s=args.older_than, larger=args.larger_than, keep=args.keep or 0)
    total = sum(run.bytes for run in going)
    for run in going if args.yes else ():
        try:
            stays += delete_run(run)
        except UsageError as error:  # it began to run since it was listed
            stays.append(error.message)
    latest = folder / LATEST
    if args.yes and latest.is_symlink() and not latest.exists():
        latest.unlink()  # it named a run that is gone
    for line in stays:
        warn(line)
    payload = {"folder": str(folder), "deleted": bool(args.yes), "bytes": total}
    payload |= {"runs": [run.as_json() for run in going], "left": stays}
    done = f"{len(going)} of {len(runs)} runs, {_size(total)}"
    last = f"deleted: {done}" if args.yes else f"would be deleted: {done}\nnext: the same command with --yes"
    emit(args, payload, "\n".join([*_table(going), last]))
    return EXIT_ALERT if stays else EXIT_FINE


def _table(runs: Sequence[Run]) -> list[str]:
    rows = [("begun", "verdict", "decisions", "accuracy", "dark clicks/exposure", "size", "bundle", "folder")]
    for run in runs:
        verdict = one_line(f"{run.verdict}{' SIMULATED' if run.simulated else ''}", 40)
        begun = run.started.astimezone().strftime("%Y-%m-%d %H:%M")
        decisions = "" if run.decisions is None else str(run.decisions)
        accuracy = "" if run.accuracy is None else f"{100 * run.accuracy:.1f} %"
        if run.accuracy is not None and run.judged is not None and run.judged != run.decisions:
            accuracy += f" of {run.judged}"
        dark = "" if run.dark_per_exposure is None else f"{run.dark_per_exposure:.2g}"
        names = one_line(run.bundle, 40), one_line(run.folder.name, 80)
        rows.append((begun, verdict, decisions, accuracy, dark, _size(run.bytes), *names))
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows] if runs else []


def _size(count: int) -> str:
    for unit, factor in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"


RUNS_COMMAND = Command(
    "list recorded runs, or delete old and large ones",
    _configure,
    _run,
    ("pans runs", "pans runs prune --older-than 30d --keep 20", "pans runs prune --larger-than 5GB --yes"),
)
