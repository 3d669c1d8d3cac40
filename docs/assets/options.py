"""The examples and tables of options on the page of commands, made from the commands themselves when the site is built.

A line `<!-- options of pans NAME -->` becomes both; a command that cannot be loaded here (its extra is not installed) names `pans help`.
"""

import argparse
import re
from typing import Any

COMMON = (
    "--help",
    "--json",
    "--quiet",
    "--verbose",
    "--debug",
    "--log-file",
    "--log-format",
    "--log-rotate-mb",
)  # on top of the page
MARK = re.compile(r"^<!-- options of pans (\S+) -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill every mark of a page (called by mkdocs)."""
    return MARK.sub(lambda mark: options_table(mark[1]), markdown)


def options_table(name: str) -> str:
    """Return the examples of `pans NAME` and its options, in Markdown."""
    from pans.app.command import parser_of
    from pans.app.find_commands import find_commands

    point = find_commands()[name]
    try:
        command = point.load()
        parser = parser_of(name, command)
    except ModuleNotFoundError:
        return f"`pans help {name}` lists the options."
    rows = [
        _row(action)
        for action in parser._actions
        if action.help != argparse.SUPPRESS and not set(COMMON) & set(action.option_strings)
    ]
    examples = ["```console", *(f"$ {line}" for line in command.examples), "```", ""] if command.examples else []
    return "\n".join([*examples, "| option | meaning |", "| --- | --- |", *rows])


def _row(action: argparse.Action) -> str:
    value = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    choices = ", ".join(f"`{one}`" for one in action.choices or ())
    names = ", ".join(f"`{name}`" for name in action.option_strings) or f"`{action.dest}`"
    shown = f"{names} `{value}`" if action.option_strings and action.nargs != 0 and not choices else names
    text = (action.help or "") % {**vars(action), "default": action.default}
    cells = (shown.replace("|", "\\|"), (f"{text}: {choices}" if choices else text).replace("|", "\\|"))
    return f"| {cells[0]} | {cells[1]} |"
