"""The parser of one command: the options that every command has, a short usage line, examples, and errors with a remedy.

Owns how help looks and how a wrong option is reported; which options a command has is the command's.
"""

from __future__ import annotations

import argparse
import re
from difflib import get_close_matches
from typing import Any, NoReturn

from pans.runtime.errors import UsageError
from pans.runtime.logs import add_log_options
from pans.runtime.ranges import FINITE, WHOLE

from .command import EXIT_USAGE, Command
from .talk import fail


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors look like all others; its numbers are never nan, infinite or beyond 64 bits."""

    def __init__(self, **settings: Any) -> None:
        settings.setdefault("formatter_class", _Formatter)
        super().__init__(**settings)
        for kind, numbers in ((int, WHOLE), (float, FINITE)):
            self.register("type", kind, numbers.option)

    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the remedy, and end with the exit code of usage errors."""
        name = self.prog.removeprefix("pans ")
        remedy = (
            f"`pans help {name}` lists the options" if " " not in name else f"`{self.prog} --help` lists the options"
        )
        near = self._nearest(message)
        raise SystemExit(fail(UsageError(message, remedy=f"{near}{remedy}"), EXIT_USAGE))

    def _nearest(self, message: str) -> str:
        """Return a question with the options that an unknown one may mean, "" where none is near."""
        unknown = re.match(r"unrecognized arguments: (--[\w-]+)", message)
        known = [option for option in self._option_string_actions if option.startswith("--")]
        near = get_close_matches(unknown[1], known, n=2) if unknown else []
        return f"did you mean {' or '.join(near)}? " if near else ""

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


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30)


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


def _positional(action: argparse.Action) -> str:
    name = _metavar(action)
    return {"?": f"[{name}]", "*": f"[{name} ...]", "+": f"{name} [...]"}.get(str(action.nargs), name)


def _metavar(action: argparse.Action) -> str:
    """Return how an argument's value is named, in capitals where argparse would list the choices."""
    if isinstance(action.metavar, str):
        return action.metavar
    return action.dest.upper()
