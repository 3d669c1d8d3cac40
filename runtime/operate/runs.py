"""`pans runs`: list what lies in a folder of runs, and prune it.

Owns the arguments and how the list looks; the facts and the rule of deletion are inventory.py's.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, emit, warn
from pans.runtime.errors import UsageError
from pans.runtime.ranges import Range
from pans.runtime.run_folder import LATEST, RUNS
from pans.runtime.safe_text import one_line

from .inventory import Run, delete_run, prunable, runs_in

KEEP = Range(0, 1_000_000, whole=True)
_TIMES = {"s": 1, "min": 60, "h": 3600, "d": 86400, "w": 7 * 86400, "y": 365 * 86400}
_SIZES = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
_QUANTITY = re.compile(r"(\d{1,12}(?:\.\d{1,6})?)\s?([A-Za-z]+)")


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
    parser.add_argument(
        "what", nargs="*", metavar="[prune] [FOLDER]", help=f"list or prune this folder (default {RUNS})"
    )
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
    for name in ("older_than", "larger_than", "keep", "yes"):
        if getattr(args, name) not in (None, False):
            option = name.replace("_", "-")
            raise UsageError(f"--{option} has no effect on a list", remedy=f"pans runs prune --{option} ...")
    runs = runs_in(folder)
    latest = folder / LATEST
    payload = {
        "folder": str(folder),
        "latest": str(latest.resolve()) if latest.is_symlink() else None,
        "bytes": sum(run.size for run in runs),
        "runs": [run.as_json() for run in runs],
    }
    emit(
        args,
        payload,
        "\n".join([*_table(runs), f"{len(runs)} runs, {_size(sum(run.size for run in runs))} in {folder}"]),
    )
    return EXIT_FINE


def _prune(args: argparse.Namespace, folder: Path) -> int:
    if args.older_than is None and args.larger_than is None and args.keep is None:
        raise UsageError(
            "`pans runs prune` needs to know which runs may go", remedy="give --older-than, --larger-than or --keep"
        )
    runs = runs_in(folder)
    going = prunable(runs, older_s=args.older_than, larger=args.larger_than, keep=args.keep or 0)
    total = sum(run.size for run in going)
    stays: list[str] = []
    if args.yes:
        for run in going:
            try:
                stays += delete_run(run)
            except UsageError as error:  # it began to run since it was listed
                stays.append(error.message)
        _mend_latest(folder)
    for line in stays:
        warn(line)
    payload = {
        "folder": str(folder),
        "deleted": bool(args.yes),
        "bytes": total,
        "runs": [run.as_json() for run in going],
        "left": stays,
    }
    done = f"{len(going)} of {len(runs)} runs, {_size(total)}"
    last = f"deleted: {done}" if args.yes else f"would be deleted: {done}\nnext: the same command with --yes"
    emit(args, payload, "\n".join([*_table(going), last]))
    return EXIT_ALERT if stays else EXIT_FINE


def _mend_latest(folder: Path) -> None:
    """A link to a run that is gone goes too."""
    latest = folder / LATEST
    if latest.is_symlink() and not latest.exists():
        latest.unlink()


def _table(runs: Sequence[Run]) -> list[str]:
    rows = [("begun", "verdict", "decisions", "accuracy", "size", "bundle", "folder"), *(_row(run) for run in runs)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return lines if runs else []


def _row(run: Run) -> tuple[str, ...]:
    accuracy = "" if run.accuracy is None else f"{100 * run.accuracy:.1f} %"
    verdict = f"{run.verdict}{' SIMULATED' if run.simulated else ''}"
    begun = run.started.astimezone().strftime("%Y-%m-%d %H:%M")
    decisions = "" if run.decisions is None else str(run.decisions)
    return (
        begun,
        one_line(verdict, 40),
        decisions,
        accuracy,
        _size(run.size),
        one_line(run.bundle, 40),
        one_line(run.folder.name, 80),
    )


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
