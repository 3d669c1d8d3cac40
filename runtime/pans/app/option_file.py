"""A command's options in a TOML file: `--config` reads them, `--write-config` writes them, each key an option's long name.

What a file says becomes words of the command line, before those that were typed: these win. `--unset` leaves out an option of the file.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pans.base import __version__
from pans.base.errors import ConfigError, UsageError
from pans.base.files import check_outputs, position_of, read_toml, toml_text, write_file

FILE_MAX_BYTES = 1 << 20
HERE = ("config", "write_config", "unset", "help", "json", "quiet", "verbose", "debug")  # of the command line alone


def add_option_file(parser: argparse.ArgumentParser) -> None:
    """Add `--config`, `--write-config` and `--unset` to a command whose `prepare` is `prepare_options`."""
    group = parser.add_argument_group("options in a file (docs/how-to/run-for-days.md)")
    group.add_argument("--config", type=Path, metavar="FILE", help="read options from this TOML file")
    group.add_argument("--unset", action="append", default=[], metavar="NAME", help="leave out an option of the file")
    what = "write all options to this TOML file, and do not run"
    group.add_argument("--write-config", type=Path, metavar="FILE", help=what)


def prepare_options(parser: argparse.ArgumentParser, words: Sequence[str]) -> list[str]:
    """Return `words` behind those of the file that they name; ConfigError for what the file cannot mean."""
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    finder.add_argument("--config", type=Path, nargs="?")
    finder.add_argument("--unset", action="append", nargs="?")
    asked = vars(finder.parse_known_args(list(words))[0])
    parser.set_defaults(option_parser=parser)
    path, unset = asked.get("config"), [name or "" for name in asked.get("unset", [])]
    if path is None:
        if unset:
            raise UsageError("--unset has no effect without a file of options", remedy="name the file with --config")
        return list(words)
    options = _options(parser)
    given, where = _read(path, options)
    for name in unset:
        if given.pop(name.removeprefix("--"), None) is None:
            known = ", ".join(given) or "none"
            raise UsageError(f"--unset {name}: {path} has no such option", remedy=f"it has: {known}")
    typed, before = {word.partition("=")[0] for word in words}, list[str]()
    for name, value in given.items():
        action, place = options[name], f"{where(name)}: {name}"
        values = _values(parser, action, value, place)
        if not action.option_strings:
            action.default, action.required, action.nargs = values[0], False, "?"
        # a typed list replaces the file's
        elif not (isinstance(action, argparse._AppendAction) and f"--{name}" in typed):
            before += [f"--{name}" if text is True else f"--{name}={text}" for text in values]
    return [*before, *words]


def write_options(args: argparse.Namespace, inputs: Iterable[str | Path | None] = ()) -> Path:
    """Write all options of `args`, parsed by a parser that `prepare_options` has seen, to `args.write_config`; return it.

    UsageError where that is one of `inputs`, which the command reads, or the file of options itself.
    """
    path: Path = args.write_config
    check_outputs([path], inputs=[args.config, *inputs], force=args.force)
    written = f"# Options of `{args.option_parser.prog}`, written by pans {__version__}. Read them with --config FILE."
    lines = [written, ""]
    for name, action in _options(args.option_parser).items():
        lines += _entry(name, action, getattr(args, action.dest))
    write_file(path, ("\n".join(lines).rstrip("\n") + "\n").encode(), force=args.force)
    return path


def _options(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Return what a file may hold: the long name of each option, and the positional arguments."""
    return {
        max(action.option_strings, key=len, default=action.dest).lstrip("-"): action
        for action in parser._actions
        if action.dest not in HERE and not (action.option_strings and action.dest == argparse.SUPPRESS)
    }


def _read(path: Path, options: Mapping[str, argparse.Action]) -> tuple[dict[str, Any], Callable[[str], str]]:
    """Return the keys of the file with their values, and a call that says where a key stands."""
    remedy = "name a TOML file that --write-config has written"
    text = toml_text(path, FILE_MAX_BYTES, "a file of options", remedy=remedy)
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


def _values(parser: argparse.ArgumentParser, action: argparse.Action, value: Any, where: str) -> list[Any]:
    """Return the words after an option for its value in the file: True alone for an option without one, none where that is off."""
    found = f"{where}: found {json.dumps(value, default=str)[:60]}"
    is_list = isinstance(action, argparse._AppendAction)
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise ConfigError(f"{found}, allowed: true or false")
        return [True] if value else []
    if is_list and not isinstance(value, list):
        raise ConfigError(f'{found}, allowed: a list, such as ["a", "b"]')
    texts = []
    for item in value if is_list else [value]:
        if isinstance(item, bool) or not isinstance(item, str | int | float):
            raise ConfigError(f"{found}, allowed: a number or a text")
        if not isinstance(item, str) and action.type in (None, Path):
            raise ConfigError(f"{found}, allowed: a text in quotes")
        texts.append(item if isinstance(item, str) else repr(item))
        try:
            parser._check_value(action, parser._get_value(action, texts[-1]))
        except argparse.ArgumentError as error:
            raise ConfigError(f"{where}: {error.message}") from error
    return texts


def _entry(name: str, action: argparse.Action, value: Any) -> Iterator[str]:
    """Yield an option's comment and its line, which is a comment too where the option has not been given."""
    choices = f" ({', '.join(map(str, action.choices))})" if action.choices else ""
    yield f"# {(action.help or '').replace('%%', '%')}{choices}"
    if action.nargs == 0:
        value = value == action.const
        is_default = not value
    else:
        is_default = value is None or (bool(action.option_strings) and value == action.default)
        value = action.metavar or name.upper() if value is None else value
    yield f"{'# ' if is_default else ''}{name} = {_toml(value, name)}"
    yield ""


def _toml(value: Any, name: str) -> str:
    """Write a value: what JSON holds is TOML too, but for one control character."""
    text = json.dumps(value, ensure_ascii=False, default=str).replace("\x7f", "\\u007f")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UsageError(f"--{name} {value!a}: is not UTF-8, and cannot stand in a TOML file") from error
    return text
