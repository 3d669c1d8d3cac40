"""Options of the command line from the fields of a frozen dataclass: name, default, range and help are written once.

`add_options` fills a parser, `options_from` makes the dataclass from what was parsed, `check_options` tests one that a program made.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterator, Mapping
from dataclasses import MISSING, Field, field, fields
from pathlib import Path
from typing import Any, TypeVar

from pans.base.errors import UsageError, as_usage_error
from pans.base.numbers.ranges import Range

Options = TypeVar("Options")


def option(default: Any, help: str, *, range: Range | None = None, group: str = "", **words: Any) -> Any:
    """Return a field that is an option; `words` are those of `ArgumentParser.add_argument`, or `flag`, the option's name.

    Without `flag` an option is named like its field, without `type` or `range` it is of the default's type, and with a range the help
    calls its value N; MISSING makes it a required one. A flag without `--` is an argument by place. True or False makes an option
    without a value; a tuple goes with action="append".
    `choices` may be a call that returns them, `group` is the heading in the help.
    """
    return field(default=default, metadata={"help": help, "range": range, "group": group, **words})


def add_options(
    parser: argparse.ArgumentParser,
    kind: type[Any],
    *,
    defaults: Mapping[str, Any] | None = None,
    omit: Collection[str] = (),
) -> None:
    """Add the options of the dataclass `kind`, with other `defaults` for some fields, but without fields or groups of `omit`."""
    groups: dict[str, argparse._ActionsContainer] = {"": parser}
    for one, flag in option_fields(kind):
        title = one.metadata["group"]
        if one.name in omit or title in omit:
            continue
        if title not in groups:
            groups[title] = parser.add_argument_group(title)
        default = (defaults or {}).get(one.name, one.default)
        groups[title].add_argument(flag, **_words_of(one, flag, default))


def _words_of(one: Field[Any], flag: str, default: Any) -> dict[str, Any]:
    """Return what argparse needs to know of an option."""
    words = {key: word for key, word in one.metadata.items() if key not in ("flag", "range", "group")}
    if callable(words.get("choices")):
        words["choices"] = words["choices"]()
    if flag.startswith("-"):
        words["dest"] = one.name
        if isinstance(default, bool):
            return {"action": "store_false" if default else "store_true", **words}
        if words.get("action") == "append":
            return {"default": list(default), **words}
        needed = default is MISSING or words.get("required")
        words |= {"required": True} if needed else {"default": default}
    if one.metadata["range"] is not None:
        words.setdefault("type", one.metadata["range"].option)
        if flag.startswith("-"):
            words.setdefault("metavar", "N")
    elif isinstance(default, int | float | Path):
        words.setdefault("type", type(default))
    return words


def options_from(args: argparse.Namespace, kind: type[Options], **others: Any) -> Options:
    """Return `kind` with the options that `args` has, and `others` for fields that are no options."""
    given = {one.name: getattr(args, one.name) for one, _ in option_fields(kind) if hasattr(args, one.name)}
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}, **others)


def check_options(options: object) -> None:
    """Raise UsageError for a value outside its option's range or choices, as the parser does for what it parses."""
    for one, flag in option_fields(options):
        value, allowed = getattr(options, one.name), one.metadata["range"]
        if allowed is not None and value is not None and value != one.default:
            with as_usage_error():
                allowed.checked(value, flag)
        choices = one.metadata.get("choices", ())
        choices = choices() if callable(choices) else choices
        if choices and value not in choices:
            raise UsageError(f"{flag} is {value!r}, allowed: {', '.join(choices)}")


def changed_options(options: object) -> dict[str, Any]:
    """Return the options with another value than their default, as JSON holds them."""
    values = {one.name: (getattr(options, one.name), one.default) for one, _ in option_fields(options)}
    return {
        name: str(value) if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value
        for name, (value, default) in values.items()
        if value != default
    }


def refuse_without(options: object, needed: str, defaults: Mapping[str, Any]) -> None:
    """Refuse options that have no effect without the option `needed`."""
    for name, default in defaults.items():
        if getattr(options, name, default) != default:
            what = f"--{name.replace('_', '-')} has no effect without {needed}"
            raise UsageError(what, remedy=f"add {needed}, or leave it out")


def words_of(options: object) -> list[str]:
    """Return the words of a command line that gives these options, none of which is True by default; those of their default are left out.

    >>> from dataclasses import make_dataclass
    >>> Light = make_dataclass("Light", [("level", int, option(3, "how bright")), ("colour", str, option("red", "of it"))])
    >>> words_of(Light(colour="blue"))
    ['--colour=blue']
    """
    values = ((one, flag, getattr(options, one.name)) for one, flag in option_fields(options))
    return [flag if value is True else f"{flag}={value}" for one, flag, value in values if value != one.default]


def option_fields(options: Any) -> Iterator[tuple[Field[Any], str]]:
    """Yield the fields that are options, each with its flag."""
    for one in fields(options):
        if "help" in one.metadata:
            yield one, one.metadata.get("flag", "--" + one.name.replace("_", "-"))
