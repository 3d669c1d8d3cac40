"""Options of the command line made from the fields of a frozen dataclass: a default and its help are written once.

Owns the way between such a dataclass and argparse, in both directions; a field that was not made by `option` is no option.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import MISSING, Field, field, fields
from typing import Any, TypeVar

Settings = TypeVar("Settings")


def option(default: Any, help: str, **words: Any) -> Any:
    """Return a field that is an option; `words` are those of `ArgumentParser.add_argument`, or `flag`, the option's name.

    Without `flag` an option is named like its field, without `type` it is of the default's type; MISSING makes it a required one. A flag
    without `--` is an argument by place.
    """
    return field(default=default, metadata={"help": help, **words})


def add_options(parser: argparse.ArgumentParser, settings: type[Any]) -> None:
    """Add the options of the dataclass `settings`."""
    for one, flag in _options(settings):
        words = {key: word for key, word in one.metadata.items() if key != "flag"}
        if flag.startswith("--"):
            words["dest"] = one.name
            if one.default is MISSING:
                words["required"] = True
            elif words.get("action") != "store_true":
                words["default"] = list(one.default) if words.get("action") == "append" else one.default
        if not {"type", "action", "choices"} & set(words):
            words["type"] = type(one.default) if isinstance(one.default, (int, float)) else str
        parser.add_argument(flag, **words)


def settings_from(args: argparse.Namespace, settings: type[Settings]) -> Settings:
    """Return `settings` with the values of its options in `args`."""
    return settings(**{one.name: getattr(args, one.name) for one, _ in _options(settings)})


def words_of(settings: object) -> list[str]:
    """Return the words of a command line that gives these settings; those of their default are left out.

    >>> from dataclasses import make_dataclass
    >>> Light = make_dataclass("Light", [("level", int, option(3, "how bright")), ("colour", str, option("red", "of it"))])
    >>> words_of(Light(colour="blue"))
    ['--colour=blue']
    """
    values = ((one, flag, getattr(settings, one.name)) for one, flag in _options(settings))
    return [f"{flag}={value}" for one, flag, value in values if value != one.default]


def _options(settings: Any) -> Iterator[tuple[Field[Any], str]]:
    for one in fields(settings):
        if "help" in one.metadata:
            yield one, one.metadata.get("flag", "--" + one.name.replace("_", "-"))
