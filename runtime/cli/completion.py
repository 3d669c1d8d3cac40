"""`pans completion SHELL`: a static script that completes commands, options and their values in bash, zsh or fish."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

from pans.runtime.errors import UsageError
from pans.runtime.safe_text import one_line

from .command import EXIT_FINE, Command, parser_of
from .finding import find_commands, load_command
from .printing import emit, warn

INSTALL = {
    "bash": "pans completion bash > ~/.local/share/bash-completion/completions/pans",
    "zsh": "pans completion zsh > ~/.pans-completion && echo 'source ~/.pans-completion' >> ~/.zshrc",
    "fish": "pans completion fish > ~/.config/fish/completions/pans.fish",
}


class _Option(NamedTuple):
    flags: tuple[str, ...]
    choices: tuple[str, ...]
    takes_value: bool
    help: str


class _Words(NamedTuple):
    """What can follow one command: its options, and the choices of its arguments by place."""

    help: str
    options: tuple[_Option, ...]
    choices: tuple[str, ...]


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=tuple(INSTALL), help="the shell to write the script for")


def _run(args: argparse.Namespace) -> int:
    table = dict(_commands())
    script = {"bash": _bash, "zsh": _zsh, "fish": _fish}[args.shell](table)
    emit(args, {"shell": args.shell, "script": script, "install": INSTALL[args.shell]}, script)
    return EXIT_FINE


def _commands() -> Iterator[tuple[str, _Words]]:
    """Yield every command that can be loaded; one with a missing extra has no options here."""
    for name, point in sorted(find_commands().items()):
        try:
            yield name, _words_of(parser_of(name, load_command(point)))
        except UsageError as error:
            warn(f"{name} is completed without its options: {error.message}")
            yield name, _Words("", (), ())


def _words_of(parser: argparse.ArgumentParser) -> _Words:
    options: list[_Option] = []
    places: list[str] = []
    for action in parser._actions:
        choices = tuple(str(choice) for choice in action.choices or ())
        if action.option_strings:
            help = one_line((action.help or "").replace("%%", "%"), 80)
            options.append(_Option(tuple(action.option_strings), choices, action.nargs != 0, help))
        else:
            places += choices
    return _Words(parser.description or "", tuple(options), tuple(places))


def _bash(table: dict[str, _Words]) -> str:
    cases, values = [], []
    for name, words in table.items():
        flags = " ".join(flag for option in words.options for flag in option.flags)
        cases.append(f'        {name}) words="{flags}"; places="{" ".join(words.choices)}" ;;')
        for option in words.options:
            keys = "|".join(f"{name}:{flag}" for flag in option.flags)
            if option.choices:
                values.append(
                    f'        {keys}) COMPREPLY=($(compgen -W "{" ".join(option.choices)}" -- "$word")); return ;;'
                )
            elif option.takes_value:
                values.append(f'        {keys}) COMPREPLY=($(compgen -f -- "$word")); return ;;')
    lines = [
        "# completion of pans for bash; install it with",
        f"#   {INSTALL['bash']}",
        "_pans() {",
        '    local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" name="" words="" places="" one',
        '    for one in "${COMP_WORDS[@]:1:COMP_CWORD-1}"; do',
        '        case "$one" in -*) ;; *) name="$one"; break ;; esac',
        "    done",
        '    if [ -z "$name" ] || { [ "$name" = help ] && [ "$before" = help ]; }; then',
        f'        COMPREPLY=($(compgen -W "{" ".join([*table, "help", "--help", "--version"])}" -- "$word")); return',
        "    fi",
        '    case "$name:$before" in',
        *values,
        "    esac",
        '    case "$name" in',
        *cases,
        "    esac",
        '    case "$word" in',
        '        -*) COMPREPLY=($(compgen -W "$words" -- "$word")) ;;',
        '        *) COMPREPLY=($(compgen -W "$places" -- "$word") $(compgen -f -- "$word")) ;;',
        "    esac",
        "}",
        "complete -o filenames -F _pans pans",
    ]
    return "\n".join(lines)


def _zsh(table: dict[str, _Words]) -> str:
    return "\n".join(
        [
            "# completion of pans for zsh, by way of its support for bash; install it with",
            f"#   {INSTALL['zsh']}",
            "autoload -U +X compinit && compinit",
            "autoload -U +X bashcompinit && bashcompinit",
            _bash(table),
        ]
    )


def _fish(table: dict[str, _Words]) -> str:
    lines = ["# completion of pans for fish; install it with", f"#   {INSTALL['fish']}"]
    names = " ".join([*table, "help"])
    for name, words in table.items():
        lines.append(
            f"complete -c pans -n 'not __fish_seen_subcommand_from {names}' -f -a {name} -d {_quoted(words.help)}"
        )
        seen = f"-n '__fish_seen_subcommand_from {name}'"
        if words.choices:
            lines.append(f"complete -c pans {seen} -a {_quoted(' '.join(words.choices))}")
        for option in words.options:
            flags = " ".join(f"-l {flag[2:]}" if flag.startswith("--") else f"-s {flag[1:]}" for flag in option.flags)
            value = (
                f" -x -a {_quoted(' '.join(option.choices))}" if option.choices else " -r" if option.takes_value else ""
            )
            lines.append(f"complete -c pans {seen} {flags}{value} -d {_quoted(option.help)}")
    return "\n".join(lines)


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


COMPLETION = Command(
    "print a completion script for bash, zsh or fish",
    _configure,
    _run,
    (f"{INSTALL['bash']}", "source <(pans completion bash)"),
)
