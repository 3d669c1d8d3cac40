"""`pans profile`: list, show and check hardware profiles, and begin a new one from a commented template."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pans.app.command import Command, add_force
from pans.base.console import emit, say
from pans.base.errors import EXIT_FINE, UsageError
from pans.base.files import check_outputs, write_file
from pans.instrument.profile import (
    Profile,
    load_profile,
    parse_profile,
    profile_template,
    profile_text,
    shipped_profiles,
)

ACTIONS = ("list", "show", "check", "new")
DEFAULT_BASE = "oled-qcmos"


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("action", choices=ACTIONS, help="list the shipped ones, show or check profiles, or write a new one")
    add("names", nargs="*", metavar="NAME", help="shipped names or .toml files; of new: the file to write")
    add("--from", dest="base", metavar="NAME", help=f"of new: the profile to begin with (default {DEFAULT_BASE})")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    if args.action != "new" and (args.base is not None or args.force):
        option = "--force" if args.base is None else "--from"
        raise UsageError(f"{option} has no effect on `pans profile {args.action}`", remedy="it belongs to new")
    return {"list": _list, "show": _show, "check": _check, "new": _new}[args.action](args)


def _list(args: argparse.Namespace) -> int:
    if args.names:
        raise UsageError("`pans profile list` takes no names", remedy=f"pans profile show {args.names[0]}")
    profiles = [load_profile(name) for name in shipped_profiles()]
    rows = [{"name": one.name, "mode": one.mode, "description": one.description} for one in profiles]
    width = max(len(one.name) for one in profiles)
    text = "\n".join(f"{row['name']:<{width}}  {row['mode']:<10}  {row['description']}" for row in rows)
    emit(args, {"rows": rows}, text)
    return EXIT_FINE


def _show(args: argparse.Namespace) -> int:
    name = _only_name(args, "pans profile show oled-qcmos")
    profile = load_profile(name)
    emit(args, {**_facts(name, profile), "toml": profile.text}, profile_text(name).rstrip("\n"))
    return EXIT_FINE


def _check(args: argparse.Namespace) -> int:
    from pans.instrument.click_law import law_warnings

    if not args.names:
        raise UsageError("no profile was named", remedy="pans profile check my-lab.toml")
    rows, lines = [], list[str]()
    for name in args.names:
        profile = load_profile(name)  # the first fault is an error with file, line and column
        warnings = law_warnings(profile, profile.exposure.min_us)
        lines.append(f"ok        {name}: {profile.name}, {profile.mode}, {profile.detector.channels} channel(s)")
        lines += [f"          to be measured: {key}" for key in profile.measure]
        lines += [f"          warning: {text}" for text in warnings]
        rows.append(_facts(name, profile) | {"warnings": warnings})
    emit(args, {"ok": True, "rows": rows}, "\n".join(lines))
    return EXIT_FINE


def _new(args: argparse.Namespace) -> int:
    path, base = Path(_only_name(args, "pans profile new my-lab.toml")), args.base or DEFAULT_BASE
    if path.suffix != ".toml":
        remedy = f"pans profile new {path.name or 'my-lab'}.toml"
        raise UsageError(f"{path}: a profile's name ends in .toml", remedy=remedy)
    if path.stem in shipped_profiles():
        raise UsageError(f"{path.stem} is the name of a shipped profile", remedy="choose a name of your own")
    check_outputs([path], inputs=[base], force=args.force)
    text = profile_template(path.stem, base)
    profile = parse_profile(text, str(path))  # a name that cannot be one is refused before anything is written
    write_file(path, text.encode(), force=args.force)
    emit(args, {**_facts(str(path), profile), "from": base}, str(path))
    say(f"next: put in your figures, then pans profile check {path}")
    return EXIT_FINE


def _only_name(args: argparse.Namespace, example: str) -> str:
    if len(args.names) != 1:
        raise UsageError(f"`pans profile {args.action}` takes one name, found {len(args.names)}", remedy=example)
    return str(args.names[0])


def _facts(path: str, profile: Profile) -> dict[str, Any]:
    facts = {name: getattr(profile, name) for name in ("name", "mode", "description", "sha256")}
    return {"profile": path, **facts, "measure": list(profile.measure)}


PROFILE = Command(
    "list, show and check hardware profiles, or begin one of your own",
    _configure,
    _run,
    ("pans profile list", "pans profile new my-lab.toml --from dmd-spad", "pans profile check my-lab.toml"),
)
