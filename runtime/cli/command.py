"""What a command is, and the exit codes of the contract."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

EXIT_FINE, EXIT_ALERT, EXIT_USAGE, EXIT_DEVICE, EXIT_TIMING, EXIT_INTERRUPTED = 0, 1, 2, 3, 4, 130
EXIT_INTERNAL = 70  # a fault of pans itself: EX_SOFTWARE of sysexits.h


@dataclass(frozen=True, slots=True)
class Command:
    """One subcommand: `configure` adds its arguments, `run` does the work and returns the exit code.

    `examples` are command lines for the end of `--help`. `prepare`, if given, returns the words to be parsed.
    """

    help: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    examples: tuple[str, ...] = ()
    prepare: Callable[[argparse.ArgumentParser, Sequence[str]], list[str]] | None = None


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add `--force`, of every command that writes files."""
    parser.add_argument("--force", action="store_true", help="replace files that exist")


def new_file(text: str) -> Path:
    """Return the path of a file to write, for argparse: `/`, `.` and nothing name none, and have no name that others could be made of."""
    path = Path(text)
    if not path.name or path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r} is a folder, expected the name of a file")
    return path


def add_new_bundle(parser: argparse.ArgumentParser, metavar: str = "OUT.pans") -> None:
    """Add `-o` and `--force` of a command whose work is a bundle."""
    parser.add_argument("-o", "--out", type=new_file, required=True, metavar=metavar, help="the bundle to write")
    add_force(parser)
