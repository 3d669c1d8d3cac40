"""`pans service`: a systemd unit for a run whose options are in a file: written, shown, verified, removed; and what Prometheus needs.

Owns the command. It writes and removes unit files and asks `systemd-analyze` about them; starting and stopping services is systemctl's.
"""

from __future__ import annotations

import argparse
import getpass
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pans.runtime import SHIPPED
from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, add_force, emit, say, warn
from pans.runtime.cli.command import parser_of
from pans.runtime.cli.finding import find_commands, load_command
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs, make_folder, write_file
from pans.runtime.ranges import Range
from pans.runtime.run_folder import RUNS

from .notify_check import Heard, start_and_hear
from .unit import (
    START_S,
    STOP_S,
    Service,
    check_name,
    command_of,
    is_unit_of_ours,
    quoted,
    read_unit,
    unit_text,
    units_folder,
)

WATCHDOG = Range(16, 3600)  # a run that looks for its lost device may be silent for 15 s
START = Range(1, 86400)
ANALYZE_S = 60
MONITORING = ("prometheus-alerts.yml", "grafana-dashboard.json")
OF_ACTION = {  # options that have an effect with each action, beside --name, --user and --unit-dir
    "install": {"config", "folder", "run_as", "watchdog_s", "force"},
    "show": {"config", "folder", "run_as", "watchdog_s"},
    "verify": {"start"},
    "remove": set(),
    "monitoring": {"out", "force"},
}


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "action",
        metavar="ACTION",
        choices=tuple(OF_ACTION),
        help="install, show, verify or remove the unit; or write what Prometheus and Grafana need",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="options of the run (pans run --write-config)")
    parser.add_argument("--name", metavar="NAME", help="the unit is pans-NAME.service (default: the name of the file)")
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where the run works (default: this folder)")
    parser.add_argument("--run-as", metavar="USER", help="whom the service runs as (default: the present user)")
    parser.add_argument(
        "--watchdog-s", type=WATCHDOG.option, metavar="S", help="restart after S s of silence (default 20)"
    )
    parser.add_argument("--user", action="store_true", help="a unit of the user's own manager, not of the system's")
    parser.add_argument("--unit-dir", type=Path, metavar="DIR", help="where units are (default: systemd's folder)")
    parser.add_argument(
        "--start", type=START.option, metavar="S", help="verify: run it for S s and check what it tells systemd"
    )
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help="monitoring: the folder to write to")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    _check_effects(args)
    if args.action == "monitoring":
        return _monitoring(args)
    path = units_folder(args.unit_dir, user=args.user) / f"pans-{check_name(_name(args))}.service"
    if args.action == "verify":
        return _verify(args, path)
    if args.action == "remove":
        return _remove(args, path)
    text = unit_text(_service(args))
    if args.action == "show":
        emit(args, {"unit": str(path), "text": text}, text.rstrip("\n"))
        return EXIT_FINE
    return _install(args, path, text)


def _check_effects(args: argparse.Namespace) -> None:
    allowed = OF_ACTION[args.action]
    for option in sorted(set().union(*OF_ACTION.values()) - allowed):
        if getattr(args, option) not in (None, False):
            name = option.replace("_", "-")
            raise UsageError(f"--{name} has no effect with `pans service {args.action}`", remedy="leave it out")


def _name(args: argparse.Namespace) -> str:
    if args.name:
        return str(args.name)
    if args.config is None:
        given = "--config" if args.action in ("install", "show") else "--name"
        raise UsageError(f"`pans service {args.action}` needs {given}", remedy=f"name the service with {given}")
    return str(args.config.stem)


# ---- install ----


def _service(args: argparse.Namespace) -> Service:
    if args.config is None:
        raise UsageError(
            f"`pans service {args.action}` needs --config",
            remedy="write the options to a file: pans run ... --write-config",
        )
    folder = (args.folder or Path.cwd()).resolve()
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder", remedy="make it first")
    config = args.config.resolve()
    writes = tuple(sorted({*_written_folders(config, folder)}))
    command = (sys.executable, "-m", "pans", "run", "--config", str(config))
    user = "" if args.user else args.run_as or os.environ.get("SUDO_USER") or getpass.getuser()
    return Service(_name(args), command, folder, writes, args.watchdog_s or 20.0, user)


def _written_folders(config: Path, folder: Path) -> Iterator[Path]:
    """Yield the folders that the run of these options writes to, seen from `folder`; the options are checked as a run checks them."""
    run = load_command(find_commands()["run"])
    parser = parser_of("run", run)
    words = ["--config", str(config)]
    if run.prepare is not None:
        run.prepare(parser, words)
    options = parser.parse_args(words)
    if options.seconds or options.decisions:
        warn(f"{config.name} ends the run by itself (seconds, decisions); a service that ends so is not started again")
    for name in ("out", "record"):
        if getattr(options, name) is not None:
            warn(f"{config.name} has `{name}`: a second start is refused, as the files of the first are there")
    yield folder / RUNS if options.out is None and options.record is None else folder
    for name in ("record", "state", "trace", "log_file"):
        if (path := getattr(options, name)) is not None:
            yield (folder / path).parent
    if options.out is not None:
        yield folder / options.out


def _install(args: argparse.Namespace, path: Path, text: str) -> int:
    check_outputs([path], inputs=[args.config], force=args.force, ours=is_unit_of_ours, makes_folders=True)
    make_folder(path.parent)
    command, folder = command_of(text)
    for place in (one for one in _service(args).writes if not one.exists()):
        make_folder(place)  # a unit's ReadWritePaths must exist
    write_file(path, text.encode(), force=True)
    findings = list(_analysed(path, user=args.user))
    manager = "systemctl --user" if args.user else "systemctl"
    following = [f"{manager} daemon-reload", f"{manager} enable --now {path.name}"]
    payload = {"unit": str(path), "command": command, "folder": str(folder), "findings": findings, "next": following}
    emit(args, payload, "\n".join([str(path), *_lines(findings), *(f"next: {line}" for line in following)]))
    return _code(findings)


# ---- verify ----


def _verify(args: argparse.Namespace, path: Path) -> int:
    text = read_unit(path)
    findings = list(_analysed(path, user=args.user))
    command, folder = command_of(text)
    there = Path(command[0]).is_file() and folder.is_dir()
    findings.append(_finding("command and folder", there, f"{command[0]} in {folder}", "install the unit again"))
    if args.start is not None and there:
        watchdog_s = float(text.partition("\nWatchdogSec=")[2].partition("\n")[0])
        say(f"starting {path.name} for {args.start:g} s ...")
        told_s = min(watchdog_s, args.start / 3)  # a run speaks three times in that time: nine times while it is heard
        heard, errors = start_and_hear(
            command, folder, watchdog_s=told_s, seconds=args.start, start_s=START_S, stop_s=STOP_S
        )
        findings += _judged(heard, errors, watchdog_s)
    emit(args, {"unit": str(path), "findings": findings}, "\n".join([str(path), *_lines(findings)]))
    return _code(findings)


def _analysed(path: Path, *, user: bool) -> Iterator[Mapping[str, Any]]:
    """Yield what `systemd-analyze verify` finds wrong with the unit, or that it is not there."""
    program = shutil.which("systemd-analyze")
    if program is None:
        yield _finding("systemd-analyze", True, "not installed: the unit's directives were not checked", "")
        return
    words = [program, *(["--user"] if user else []), "--man=no", "verify", str(path)]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=ANALYZE_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        yield _finding("systemd-analyze", False, f"could not be asked: {error}", f"run it by hand: {' '.join(words)}")
        return
    said = [line for line in done.stderr.splitlines() if path.name in line or done.returncode]
    found = "; ".join(said) or "no complaints"
    yield _finding("systemd-analyze", not said and done.returncode == 0, found, "install the unit again")


def _judged(heard: Heard, errors: str, watchdog_s: float) -> Iterator[Mapping[str, Any]]:
    """Yield what is to be said of one start, of the protocol's four parts."""
    last = errors.strip().rsplit("\n", 1)[-1]
    if heard.ready_s is None:
        yield _finding("READY", False, f"not within {START_S} s, or the run ended: {last}", "start the run by hand")
        return
    yield _finding("READY", True, f"after {heard.ready_s:.1f} s", "")
    silence_s = heard.longest_silence_s()
    said = f"{len(heard.watchdog_s)} messages, {silence_s:.2f} s apart at most, allowed {watchdog_s:g} s"
    lives = bool(heard.watchdog_s) and silence_s < watchdog_s
    yield _finding("WATCHDOG", lives, said, "the machine is too slow, or the watchdog's time too short: --watchdog-s")
    stops = heard.stopping_s is not None
    yield _finding("STOPPING", stops, "said" if stops else "not said before the process ended", "look into its log")
    ended = f"exit code {heard.exit_code}" if heard.exit_code is not None else f"not within {STOP_S} s of SIGTERM"
    alone = "" if heard.asked_s is not None else ", by itself"
    yield _finding("end", heard.exit_code in (0, 1), f"{ended}{alone}: {last}"[:400], "look into its log")


def _finding(check: str, ok: bool, found: str, remedy: str) -> Mapping[str, Any]:
    return {"check": check, "ok": ok, "found": found, "remedy": "" if ok else remedy}


def _lines(findings: list[Mapping[str, Any]]) -> Iterator[str]:
    for one in findings:
        yield f"  {'ok' if one['ok'] else 'WRONG':<6} {one['check']}: {one['found']}"
        if one["remedy"]:
            yield f"         remedy: {one['remedy']}"


def _code(findings: list[Mapping[str, Any]]) -> int:
    return EXIT_FINE if all(one["ok"] for one in findings) else EXIT_ALERT


# ---- remove, monitoring ----


def _remove(args: argparse.Namespace, path: Path) -> int:
    read_unit(path)
    try:
        path.unlink()
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be removed: {error.strerror or error}", remedy="run it as its owner"
        ) from error
    manager = "systemctl --user" if args.user else "systemctl"
    following = [f"{manager} disable --now {path.name}", f"{manager} daemon-reload"]
    emit(args, {"removed": str(path), "next": following}, f"{path} is removed\nnext: {' && '.join(following)}")
    return EXIT_FINE


def _monitoring(args: argparse.Namespace) -> int:
    if args.out is None:
        raise UsageError("`pans service monitoring` needs a folder", remedy="name one with --out")
    paths = [args.out / name for name in MONITORING]
    check_outputs(paths, force=args.force, makes_folders=True)
    make_folder(args.out)
    for path in paths:
        write_file(path, (SHIPPED / path.name).read_bytes(), force=args.force)
    scrape = quoted("127.0.0.1:9464")
    emit(
        args,
        {"files": [str(path) for path in paths]},
        "\n".join([*map(str, paths), f"next: let Prometheus scrape {scrape}, and run with --metrics 127.0.0.1:9464"]),
    )
    return EXIT_FINE


SERVICE = Command(
    "write, verify or remove a systemd unit for a run; write dashboard and alert rules",
    _configure,
    _run,
    (
        "pans service install --config lab.toml",
        "pans service verify --name lab --start 20",
        "pans service monitoring --out monitoring",
    ),
)
