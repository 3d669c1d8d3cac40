"""The `pans` command: finds the commands by entry point, runs one, and turns errors into exit codes.

Owns argument parsing of the top level, the options that every command has (`--json`, `--quiet`, `--verbose`, `--debug`), what is printed
and the exit codes of the contract; never does a command's work. `main` returns the exit status. Only the invoked command's module is
imported, so that `pans run` never pays for the trainer. Of the standard library only: nothing here loads numpy.
"""

from .command import (
    EXIT_ALERT,
    EXIT_DEVICE,
    EXIT_FINE,
    EXIT_INTERNAL,
    EXIT_INTERRUPTED,
    EXIT_TIMING,
    EXIT_USAGE,
    Command,
    add_force,
    add_new_bundle,
    new_file,
)
from .main import main
from .talk import emit, note, say, warn

__all__ = [
    "EXIT_ALERT",
    "EXIT_DEVICE",
    "EXIT_FINE",
    "EXIT_INTERNAL",
    "EXIT_INTERRUPTED",
    "EXIT_TIMING",
    "EXIT_USAGE",
    "Command",
    "add_force",
    "add_new_bundle",
    "emit",
    "main",
    "new_file",
    "note",
    "say",
    "warn",
]
