"""The `pans` command: it finds a command by entry point, runs it, and turns errors into the exit codes of the contract.

Words of the command line come in, an answer on stdout and an exit code come out. Start reading at main.py; a command is a `Command`
(command.py), its options can be fields of a dataclass (option_fields.py). Nothing here loads numpy, and only the module of the command
that is asked for is imported.
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
from .printing import emit, note, say, warn

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
