"""What a command is, its parser, and the exit codes of the contract.

The parser adds the options that every command has, a short usage line, examples, and errors with a remedy.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from pans.base.console import add_log_options, fail
from pans.base.errors import (
    EXIT_ALERT as EXIT_ALERT,
)
from pans.base.errors import (
    EXIT_DEVICE as EXIT_DEVICE,
)
from pans.base.errors import (
    EXIT_FINE as EXIT_FINE,
)
from pans.base.errors import (
    EXIT_INTERNAL as EXIT_INTERNAL,
)
from pans.base.errors import (
    EXIT_INTERRUPTED as EXIT_INTERRUPTED,
)
from pans.base.errors import (
    EXIT_TIMING as EXIT_TIMING,
)
from pans.base.errors import (
    EXIT_USAGE as EXIT_USAGE,
)
from pans.base.errors import UsageError
from pans.base.numbers import FINITE, WHOLE


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


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors look like all others; its numbers are never nan, infinite or beyond 64 bits."""

    def __init__(self, **settings: Any) -> None:
        settings.setdefault("formatter_class", partial(argparse.RawDescriptionHelpFormatter, max_help_position=30))
        super().__init__(**settings)
        for kind, numbers in ((int, WHOLE), (float, FINITE)):
            self.register("type", kind, numbers.option)

    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the remedy, and end with the exit code of usage errors."""
        name = self.prog.removeprefix("pans ")
        help = f"`pans help {name}`" if " " not in name else f"`{self.prog} --help`"
        unknown = re.match(r"unrecognized arguments: (--[\w-]+)", message)
        known = [option for option in self._option_string_actions if option.startswith("--")]
        remedy = f"{did_you_mean(unknown[1], known) if unknown else ''}{help} lists the options"
        raise SystemExit(fail(UsageError(message, remedy=remedy), EXIT_USAGE))

    def format_usage(self) -> str:
        """Return one line: required arguments by name, all others as `[options]`."""
        return f"usage: {self._usage_line()}\n"

    def _usage_line(self) -> str:
        needed = [action for action in self._actions if action.required and action.option_strings]
        named = [f"{action.option_strings[-1]} {_metavar(action)}" for action in needed]
        rest = [_positional(action) for action in self._actions if not action.option_strings]
        return " ".join([self.prog, "[options]", *named, *rest])

    def format_help(self) -> str:
        """Return the help, with the short usage line."""
        self.usage = self._usage_line().replace("%", "%%")
        return super().format_help()


def parser_of(name: str, command: Command) -> CommandParser:
    """Return the parser of the command `name`, with the options that every command has at the end of its help."""
    examples = "\n".join(f"  {line}" for line in command.examples)
    epilog = f"examples:\n{examples}" if examples else None
    description = command.help[:1].upper() + command.help[1:]
    # "resolve": a lab's own command may use -q or -v for something else
    parser = CommandParser(prog=f"pans {name}", description=description, epilog=epilog, conflict_handler="resolve")
    shared = parser.add_argument_group("output (the same for every command)")
    shared.add_argument(
        "--json", action="store_true", help="print one JSON object on stdout, everything else on stderr"
    )
    shared.add_argument("-q", "--quiet", action="store_true", help="print only the answer, warnings and errors")
    shared.add_argument("-v", "--verbose", action="store_true", help="print what is chosen and loaded on the way")
    shared.add_argument("--debug", action="store_true", help="show the traceback of an error")
    add_log_options(shared)
    command.configure(parser)
    parser._action_groups.remove(shared)
    parser._action_groups.append(shared)  # the command's own options first
    return parser


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a question with the words that an unknown one may stand for, "" where none is near."""
    near = get_close_matches(word, known, n=2, cutoff=0.75)  # --decisions is no --seconds
    return f"did you mean {' or '.join(near)}? " if near else ""


def _positional(action: argparse.Action) -> str:
    name = _metavar(action)
    return {"?": f"[{name}]", "*": f"[{name} ...]", "+": f"{name} [...]"}.get(str(action.nargs), name)


def _metavar(action: argparse.Action) -> str:
    """Return how an argument's value is named, in capitals where argparse would list the choices."""
    return action.metavar if isinstance(action.metavar, str) else action.dest.upper()
