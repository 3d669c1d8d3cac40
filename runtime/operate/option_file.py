"""A command's options in a TOML file: `--config` reads them, `--write-config` writes them, each key an option's long name.

Owns the way between a file and the parser of a command, for whatever options that parser has; the options' own rules are checked by the
parser's types. What the command line says overrides the file; `--unset` takes an option of the file back.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pans.runtime import __version__
from pans.runtime.container import other_kind, read_file
from pans.runtime.errors import ConfigError, PansError, UsageError
from pans.runtime.instrument.checked_toml import position_of, read_toml
from pans.runtime.outputs import check_outputs, write_file

FILE_MAX_BYTES = 1 << 20
_OWN_DEFAULT = "_own_default"  # of an action whose default is a file's value
HERE = ("config", "write_config", "unset", "help", "json", "quiet", "verbose", "debug")  # of the command line alone


def add_option_file(parser: argparse.ArgumentParser) -> None:
    """Add `--config`, `--write-config` and `--unset` to a command whose `prepare` is `prepare_options`."""
    group = parser.add_argument_group("options in a file (docs/how-to/run-for-days.md)")
    group.add_argument("--config", type=Path, metavar="FILE", help="take the options of this TOML file")
    group.add_argument("--unset", action="append", default=[], metavar="NAME", help="leave out an option of the file")
    group.add_argument(
        "--write-config", type=Path, metavar="FILE", help="write all options to this TOML file, and do not run"
    )


def prepare_options(parser: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """Make the options of the file that `words` name the parser's defaults; ConfigError for what the file cannot mean."""
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    finder.add_argument("--config", type=Path, nargs="?")
    finder.add_argument("--unset", action="append", nargs="?")
    asked = vars(finder.parse_known_args(list(words))[0])
    parser.set_defaults(option_parser=parser)
    path, unset = asked.get("config"), [name or "" for name in asked.get("unset", [])]
    if path is None:
        if unset:
            raise UsageError("--unset has no effect without a file of options", remedy="name the file with --config")
        return
    options = _options(parser)
    given, where = _read(path, options)
    for name in unset:
        if given.pop(name.removeprefix("--"), None) is None:
            raise UsageError(
                f"--unset {name}: {path} has no such option", remedy=f"it has: {', '.join(given) or 'none'}"
            )
    for name, value in given.items():
        _make_default(parser, options[name], _converted(parser, options[name], value, f"{where(name)}: {name}"))


def write_options(args: argparse.Namespace, inputs: Iterable[str | Path | None] = ()) -> Path:
    """Write all options of `args`, parsed by a parser that `prepare_options` has seen, to `args.write_config`; return it.

    UsageError where that is one of `inputs`, which the command reads, or the file of options itself.
    """
    path: Path = args.write_config
    check_outputs([path], inputs=[args.config, *inputs], force=args.force)
    lines = [
        f"# Options of `{args.option_parser.prog}`, written by pans {__version__}. Read them with --config FILE.",
        "",
    ]
    for name, action in _options(args.option_parser).items():
        lines += _entry(name, action, getattr(args, action.dest))
    write_file(path, ("\n".join(lines).rstrip("\n") + "\n").encode(), force=args.force)
    return path


def _options(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Return what a file may hold: the long name of each option, and the positional arguments."""
    found = {}
    for action in parser._actions:
        if action.dest not in HERE and not (action.option_strings and action.dest == argparse.SUPPRESS):
            found[max(action.option_strings, key=len, default=action.dest).lstrip("-")] = action
    return found


# ---- reading ----


def _read(path: Path, options: Mapping[str, argparse.Action]) -> tuple[dict[str, Any], Any]:
    """Return the keys of the file with their values, and a call that says where a key stands."""
    try:
        data = read_file(path, FILE_MAX_BYTES)
        what, taker = other_kind(data, "TOML")
        if what:
            remedy = f"{taker}; `pans run ... --write-config FILE` writes a file of options"
            raise ConfigError(f"{path}: not a file of options: it is {what}", remedy=remedy)
        text = data.decode()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}:1:1: not UTF-8: {error.reason} at byte {error.start}") from error
    except ConfigError:
        raise
    except PansError as error:
        raise type(error)(error.message, remedy="name a TOML file that --write-config has written") from error
    given, positions = read_toml(text, str(path))

    def where(name: str) -> str:
        line, column = position_of((name,), positions)
        return f"{path}:{line}:{column}"

    for name in given:
        if name not in options:
            near = get_close_matches(name.replace("_", "-"), options, n=1)
            remedy = f"did you mean {near[0]}?" if near else "see `pans run --help`, without the dashes"
            raise ConfigError(f"{where(name)}: {name}: there is no such option", remedy=remedy)
    return given, where


def _converted(parser: argparse.ArgumentParser, action: argparse.Action, value: Any, where: str) -> Any:
    """Return what the command line would make of `value`."""
    if _is_flag(action):
        if not isinstance(value, bool):
            raise ConfigError(f"{where}: found {_shown(value)}, allowed: true or false")
        return action.const if value else action.default
    if isinstance(action, argparse._CountAction):
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 9:
            raise ConfigError(f"{where}: found {_shown(value)}, allowed: a whole number from 0 to 9")
        return value
    if _is_list(action):
        if not isinstance(value, list):
            raise ConfigError(f'{where}: found {_shown(value)}, allowed: a list, such as ["a", "b"]')
        return [_one(parser, action, item, where) for item in value]
    return _one(parser, action, value, where)


def _one(parser: argparse.ArgumentParser, action: argparse.Action, value: Any, where: str) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ConfigError(f"{where}: found {_shown(value)}, allowed: a number or a text")
    if not isinstance(value, str) and action.type in (None, Path):
        raise ConfigError(f"{where}: found {_shown(value)}, allowed: a text in quotes")
    try:
        found = parser._get_value(action, value if isinstance(value, str) else repr(value))
        parser._check_value(action, found)
    except argparse.ArgumentError as error:
        raise ConfigError(f"{where}: {error.message}") from error
    return found


def _make_default(parser: argparse.ArgumentParser, action: argparse.Action, value: Any) -> None:
    """Let `value` stand where the command line says nothing."""
    if isinstance(action, argparse._AppendAction):
        _replace_appended(action, value)
    if not hasattr(action, _OWN_DEFAULT):
        setattr(action, _OWN_DEFAULT, action.default)
    action.default = value
    action.required = False
    if not action.option_strings and action.nargs is None:
        action.nargs = "?"


def _replace_appended(action: argparse._AppendAction, value: list[Any]) -> None:
    """What the command line appends begins a list of its own, in place of the file's."""
    append = type(action).__call__

    class Anew(argparse._AppendAction):
        def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
            if getattr(namespace, self.dest) is value:
                setattr(namespace, self.dest, [])
            append(self, parser, namespace, values, option)

    action.__class__ = Anew


# ---- writing ----


def _entry(name: str, action: argparse.Action, value: Any) -> Iterator[str]:
    """Yield an option's comment and its line, which is a comment too where the option has not been given."""
    words = (action.help or "").replace("%%", "%")
    choices = f" ({', '.join(map(str, action.choices))})" if action.choices else ""
    yield f"# {words}{choices}"
    if _is_flag(action):
        value = value == action.const
        is_default = not value
    else:
        is_default = value is None or value == getattr(action, _OWN_DEFAULT, action.default)
        value = action.metavar or name.upper() if value is None else value
    yield f"{'# ' if is_default else ''}{name} = {_toml(value, name)}"
    yield ""


def _toml(value: Any, name: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item, name) for item in value)}]"
    text = str(value)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UsageError(f"--{name} {text!a}: is not UTF-8, and cannot stand in a TOML file") from error
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _is_flag(action: argparse.Action) -> bool:
    return isinstance(action, argparse._StoreTrueAction | argparse._StoreFalseAction | argparse._StoreConstAction)


def _is_list(action: argparse.Action) -> bool:
    return isinstance(action, argparse._AppendAction) or action.nargs in ("*", "+") or isinstance(action.nargs, int)


def _shown(value: Any) -> str:
    return json.dumps(value, default=str)[:60]
