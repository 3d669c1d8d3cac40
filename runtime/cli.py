"""The `pans` command: finds the commands by entry point, runs one, turns errors into exit codes.

Owns argument parsing of the top level, `--json`, `--debug` and the exit codes of the contract; never does a command's work.
`main` returns the exit status. Only the invoked command's module is imported, so that `pans run` never pays for the trainer.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pans.runtime import __version__

from .errors import PansError, UsageError
from .guests import load_guest
from .ranges import FINITE, WHOLE
from .safe_text import lines, one_line

EXIT_FINE, EXIT_ALERT, EXIT_USAGE, EXIT_DEVICE, EXIT_TIMING, EXIT_INTERRUPTED = 0, 1, 2, 3, 4, 130


@dataclass(frozen=True, slots=True)
class Command:
    """One subcommand: `configure` adds its arguments, `run` does the work and returns the exit code."""

    help: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add `--force`, of every command that writes files."""
    parser.add_argument("--force", action="store_true", help="replace files that exist")


def say(text: str) -> None:
    """Print for people, on stderr: stdout belongs to the JSON object or the answer itself."""
    print(lines(text), file=sys.stderr, flush=True)


def emit(args: argparse.Namespace, payload: Mapping[str, Any], text: str = "") -> None:
    """Print one JSON object when `--json` was given, else `text`; both on stdout."""
    if args.json:
        print(json.dumps(payload, allow_nan=False, default=_plain), flush=True)
    elif text:
        print(lines(text), flush=True)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return value.tolist()
    return str(value)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `pans` with `argv` (default: the process's arguments) and return the exit code of the contract."""
    words = list(sys.argv[1:] if argv is None else argv)
    commands = {point.name: point for point in entry_points(group="pans.commands")}
    wanted = next((word for word in words if not word.startswith("-")), None)
    if wanted is None or wanted not in commands:
        return _top_level(words, wanted, commands)
    try:
        command = _load(commands[wanted])
    except PansError as error:
        return _failed(error, "--debug" in words)
    parser = argparse.ArgumentParser(prog=f"pans {wanted}", description=command.help)
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object on stdout, everything else on stderr"
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    for kind, numbers in (
        (int, WHOLE),
        (float, FINITE),
    ):  # of every option of that type: no nan, no inf, nothing beyond 64 bits
        parser.register("type", kind, numbers.option)
    command.configure(parser)
    rest = list(words)
    rest.remove(wanted)
    args = parser.parse_args(rest)
    try:
        return command.run(args)
    except PansError as error:
        return _failed(error, args.debug)
    except KeyboardInterrupt:
        say("interrupted")
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output went away: nothing more can be said to it
        return EXIT_FINE


def _load(point: EntryPoint) -> Command:
    try:
        command = load_guest(point)
    except UsageError as error:
        missing = (getattr(error.__cause__, "name", None) or "").split(".")[0]
        extra = {"torch": "train", "onnx": "train", "matplotlib": "plot", "h5py": "export"}.get(missing)
        if extra is None:
            raise
        raise UsageError(
            f"`pans {point.name}` needs the package {missing}, which is not installed",
            remedy=f"pip install 'pans-runtime[{extra}]'",
        ) from error
    if not isinstance(command, Command):
        raise UsageError(f"entry point {point.value} is a {type(command).__name__}, not a pans.runtime.cli.Command")
    return command


def _written_help(point: EntryPoint) -> str:
    """Return the help as it stands in the command's source, "" if it does not stand there as a plain text: importing all takes a second."""
    try:
        spec = find_spec(point.module)
        source = Path(spec.origin).read_text(encoding="utf-8") if spec is not None and spec.origin else ""
    except (ImportError, AttributeError, OSError):  # loading it says what is wrong
        return ""
    found = re.search(rf'^{point.attr} = Command\(\s*"([^"\\]*)",', source, re.MULTILINE)
    return found[1] if found else ""


def _failed(error: PansError, debug: bool) -> int:
    if debug:
        raise error
    remedy = f"\n  remedy: {one_line(error.remedy)}" if error.remedy else ""
    say(f"pans: {error.message}".replace("\n", "\n    ") + remedy)  # no line of a message can pass for one of ours
    return error.exit_code


def _top_level(words: Sequence[str], wanted: str | None, commands: Mapping[str, EntryPoint]) -> int:
    if "--version" in words and wanted is None:
        print(f"pans {__version__}")
        return EXIT_FINE
    if wanted is not None:
        near = get_close_matches(wanted, commands, n=2)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        say(f"pans: unknown command {wanted!r}\n  remedy: {hint}`pans` lists the commands")
        return EXIT_USAGE
    print(f"pans {__version__}: decide on a handful of photons, on time\n\nusage: pans COMMAND [options]\n")
    for name in sorted(commands):
        try:
            summary = _written_help(commands[name]) or _load(commands[name]).help
        except UsageError as error:
            summary = f"({error.message}; {error.remedy})"
        except Exception as error:  # one package's broken command must not hide all the others
            summary = f"(cannot be loaded: {error})"
        print(f"  {name:<10} {summary}")
    print("\n`pans COMMAND --help` lists a command's options. Start with `pans demo`.")
    return EXIT_FINE
