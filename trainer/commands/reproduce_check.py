"""`pans reproduce check`: whether text, JSON and command of every page of results agree.

Owns what is refused and what is printed; the check itself is `pans.trainer.claims`. Exit code 2 where something disagrees.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from pans.runtime.cli import EXIT_FINE, EXIT_USAGE, emit
from pans.runtime.errors import UsageError
from pans.trainer.claims.check import Finding, check_folder
from pans.trainer.claims.known import PAGES

FOLDER = Path("docs/results")
NO_EFFECT = {
    "rows": None,
    "dark": None,
    "data_seed": 0,
    "seeds": 5,
    "from_json": False,
    "collect": False,
    "force": False,
}


def check(args: argparse.Namespace) -> int:
    """Check the pages in the folder of -o (docs/results), print what disagrees, and return the exit code."""
    without = [f"--{key.replace('_', '-')}" for key, default in NO_EFFECT.items() if getattr(args, key) != default]
    if without:
        raise UsageError(f"{', '.join(without)}: no effect on check", remedy="leave it out")
    folder = args.out or FOLDER
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder", remedy="name the folder of the pages by -o DIR")
    faults, notes = check_folder(folder)
    found = {"pages": len(PAGES), "ok": not faults, "faults": _plain(faults), "notes": _plain(notes)}
    emit(args, found, "\n".join([*map(_line, faults), *map(_line, notes), _verdict(faults, folder)]))
    return EXIT_USAGE if faults else EXIT_FINE


def _plain(findings: list[Finding]) -> list[dict[str, str]]:
    return [asdict(one) for one in findings]


def _line(one: Finding) -> str:
    return f"{one.page}: {one.kind}: {one.words}"


def _verdict(faults: list[Finding], folder: Path) -> str:
    if faults:
        return f"{len(faults)} faults in {folder}"
    return f"text, JSON and command of {len(PAGES)} pages in {folder} agree"
