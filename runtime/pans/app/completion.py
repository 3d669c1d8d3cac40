"""`pans completion SHELL`: a static script that completes commands, options and their values in bash, zsh or fish."""

from __future__ import annotations

import argparse
from typing import NamedTuple

from pans.base.console import emit, one_line, warn
from pans.base.errors import EXIT_FINE, UsageError

from .command import Command, parser_of
from .find_commands import find_commands, load_command

INSTALL = {
    "bash": "pans completion bash > ~/.local/share/bash-completion/completions/pans",
    "zsh": "pans completion zsh > ~/.pans-completion && echo 'source ~/.pans-completion' >> ~/.zshrc",
    "fish": "pans completion fish > ~/.config/fish/completions/pans.fish",
}
ZSH = "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n"  # zsh takes bash's script
BASH = """_pans() {
    local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" name="" words="" places="" one
    for one in "${COMP_WORDS[@]:1:COMP_CWORD-1}"; do
        case "$one" in -*) ;; *) name="$one"; break ;; esac
    done
    if [ -z "$name" ] || { [ "$name" = help ] && [ "$before" = help ]; }; then
        COMPREPLY=($(compgen -W "COMMANDS help --help --version" -- "$word")); return
    fi
    case "$name:$before" in
VALUES
    esac
    case "$name" in
OPTIONS
    esac
    case "$word" in
        -*) COMPREPLY=($(compgen -W "$words" -- "$word")) ;;
        *) COMPREPLY=($(compgen -W "$places" -- "$word") $(compgen -f -- "$word")) ;;
    esac
}
complete -o filenames -F _pans pans"""


class _Words(NamedTuple):
    """What can follow one command: its options, and the choices of its arguments by place."""

    help: str
    options: tuple[argparse.Action, ...]
    choices: tuple[str, ...]


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=tuple(INSTALL), help="the shell to write the script for")


def _run(args: argparse.Namespace) -> int:
    table = {name: _words_of(name) for name in sorted(find_commands())}
    script = _fish(table) if args.shell == "fish" else _bash(table)
    head = f"# completion of pans for {args.shell}; install it with\n#   {INSTALL[args.shell]}\n"
    script = head + (ZSH if args.shell == "zsh" else "") + script
    emit(args, {"shell": args.shell, "script": script, "install": INSTALL[args.shell]}, script)
    return EXIT_FINE


def _words_of(name: str) -> _Words:
    """Return what can follow a command; nothing is known of one with a missing extra."""
    try:
        parser = parser_of(name, load_command(find_commands()[name]))
    except UsageError as error:
        warn(f"{name} is completed without its options: {error.message}")
        return _Words("", (), ())
    places = [choice for action in parser._actions if not action.option_strings for choice in _choices(action)]
    options = tuple(action for action in parser._actions if action.option_strings)
    return _Words(parser.description or "", options, tuple(places))


def _choices(action: argparse.Action) -> list[str]:
    return [str(choice) for choice in action.choices or ()]


def _bash(table: dict[str, _Words]) -> str:
    options, values = [], []
    for name, words in table.items():
        flags = " ".join(flag for option in words.options for flag in option.option_strings)
        options.append(f'        {name}) words="{flags}"; places="{" ".join(words.choices)}" ;;')
        for option in words.options:
            keys = "|".join(f"{name}:{flag}" for flag in option.option_strings)
            source = f'-W "{" ".join(_choices(option))}"' if option.choices else "-f"
            if option.nargs != 0:
                values.append(f'        {keys}) COMPREPLY=($(compgen {source} -- "$word")); return ;;')
    parts = {"COMMANDS": " ".join(table), "VALUES": "\n".join(values), "OPTIONS": "\n".join(options)}
    script = BASH
    for name, text in parts.items():
        script = script.replace(name, text, 1)
    return script


def _fish(table: dict[str, _Words]) -> str:
    lines, names = [], " ".join([*table, "help"])
    for name, words in table.items():
        unseen, seen = (f"-n '{no}__fish_seen_subcommand_from {which}'" for no, which in (("not ", names), ("", name)))
        lines.append(f"complete -c pans {unseen} -f -a {name} -d {_quoted(words.help)}")
        if words.choices:
            lines.append(f"complete -c pans {seen} -a {_quoted(' '.join(words.choices))}")
        for option in words.options:
            flags = " ".join(f"-{'l' if one[1] == '-' else 's'} {one.lstrip('-')}" for one in option.option_strings)
            value = f" -x -a {_quoted(' '.join(_choices(option)))}" if option.choices else " -r" * (option.nargs != 0)
            help = one_line((option.help or "").replace("%%", "%"), 80)
            lines.append(f"complete -c pans {seen} {flags}{value} -d {_quoted(help)}")
    return "\n".join(lines)


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


COMPLETION = Command(
    "print a completion script for bash, zsh or fish",
    _configure,
    _run,
    (INSTALL["bash"], "source <(pans completion bash)"),
)
