"""`pans service`: a systemd unit for a run whose options are in a file: written, shown, verified, removed; and what Prometheus needs.

Starting and stopping services is systemctl's. `verify --start` starts the run as systemd does and receives its messages (sd_notify(3)) on a
real socket. A unit of ours begins with MARK; others are never replaced or removed. Quoting: systemd.service(5), systemd.syntax(7).
"""

from __future__ import annotations

import argparse
import getpass
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from pans.app.command import Command, add_force, parser_of
from pans.app.find_commands import find_commands, load_command
from pans.base import SHIPPED
from pans.base.console import emit, one_line, say, warn
from pans.base.errors import EXIT_ALERT, EXIT_FINE, EXIT_TIMING, UsageError, refusing
from pans.base.files import RUNS, check_outputs, make_folder, read_file, write_file
from pans.base.machine import FIFO_PRIORITY
from pans.base.numbers import Range

from .runs import Run, runs_in

PRIVATE = (Path("/tmp"), Path("/var/tmp"))  # with PrivateTmp a service has its own
MARK = "# Written by `pans service install`; change the file of options, not this one."
SYSTEM_UNITS, USER_UNITS = Path("/etc/systemd/system"), Path("~/.config/systemd/user")
UNIT_MAX_BYTES = 1 << 16
START_S = 180  # kernels are compiled once, on a slow machine for a minute
STOP_S = 45  # the watchdog ends a stuck run within 5 s; a slow disk has 30 s to sync
SYSTEM_ONLY = ("# what only the system's manager", "[Install]")  # left out between these in a user's own unit
NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")
USER_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@-]{0,254}\$?")
_SURROGATES = re.compile("[\ud800-\udfff]")  # bytes of a file's name that are no UTF-8
_CONTROLS = (*range(1, 32), *range(127, 160))
ESCAPES = str.maketrans({"\\": "\\\\", '"': '\\"', "%": "%%"} | {chr(c): rf"\{c:03o}" for c in _CONTROLS if c < 128})
POLL_S = 0.05
NOT_THE_SERVICES = ("INVOCATION_ID", "JOURNAL_STREAM", "MAINPID")
WATCHDOG = Range(16, 3600)  # a run that looks for its lost device may be silent for 15 s
START = Range(1, 86400)
# exit codes of a run with a verdict: a busy computer does not make an installation wrong
RAN = (EXIT_FINE, EXIT_ALERT, EXIT_TIMING)
ANALYZE_S = 60
MONITORING = ("prometheus.yml", "prometheus-alerts.yml", "grafana-dashboard.json")
OF_ACTION = {  # options that have an effect with each action, beside --name, --user and --unit-dir
    "install": {"config", "folder", "run_as", "watchdog_s", "force"},
    "show": {"config", "folder", "run_as", "watchdog_s"},
    "verify": {"start"},
    "remove": set(),
    "monitoring": {"out", "force"},
}


# ---- the unit ----


def unit_text(
    name: str, command: Sequence[str], folder: Path, writes: Sequence[Path], watchdog_s: float, user: str
) -> str:
    """Return the unit of `command`, whose first word is absolute, in `folder`; it may write there and to `writes`.

    `user` is whom a unit of the system runs as, "" in a unit of a user's own manager.
    """
    template = (SHIPPED / "pans-run.service").read_text(encoding="utf-8")
    if not user:
        first, last = (template.index(mark) for mark in SYSTEM_ONLY)
        template = (template[:first] + "\n" + template[last:]).replace("User={user}\n", "")
    return template.format(
        name=name,
        command=command_line(command),
        folder=_bare(folder),
        user=_checked_user(user),
        watchdog_s=watchdog_s,
        start_s=START_S,
        stop_s=STOP_S,
        priority=FIFO_PRIORITY,
        writes="\n".join(f"ReadWritePaths={_in_quotes(path)}" for path in sorted({folder, *writes})),
        target="multi-user" if user else "default",
    )


def command_line(words: Sequence[str]) -> str:
    """Return the value of ExecStart for a command: words in quotes, with systemd's escapes, specifiers and variables doubled.

    >>> command_line(["/usr/bin/pans", "run", "50%.pans", "$HOME"])
    '"/usr/bin/pans" "run" "50%%.pans" "$$HOME"'
    """
    return " ".join(f'"{_escaped(word)}"' for word in words).replace("$", "$$")


def command_of(text: str) -> tuple[list[str], Path]:
    """Return the command and the working directory of the unit `text`, which is one of ours; UsageError if they are not there."""
    values = {key: value for key, _, value in (line.partition("=") for line in text.split("\n"))}
    words = [_unescaped(found) for found in re.findall(r'"((?:[^"\\]|\\.)*)"', values.get("ExecStart", ""))]
    folder = values.get("WorkingDirectory", "").replace("%%", "%")
    if not words or not folder:
        raise UsageError("the unit has no ExecStart or no WorkingDirectory", remedy="install it again")
    return [word.replace("$$", "$") for word in words], Path(folder)


def _escaped(text: str) -> str:
    if _SURROGATES.search(text):
        raise UsageError(f"{text}: a unit cannot name it: bytes that are no UTF-8", remedy="rename the file")
    return text.translate(ESCAPES)


def _unescaped(text: str) -> str:
    def one(found: re.Match[str]) -> str:
        return chr(int(found[1], 8)) if found[1].isdigit() else found[1]

    return re.sub(r"\\([0-7]{3}|.)", one, text.replace("%%", "%"))


def _bare(path: Path) -> str:
    """Return a path as systemd reads a value that it neither unquotes nor unescapes; UsageError for one that cannot be written so."""
    text = str(path)
    if (
        any(ord(letter) in _CONTROLS for letter in text)
        or _SURROGATES.search(text)
        or text.strip().rstrip("\\") != text
    ):
        what = "a unit cannot name it: control characters, bytes that are no UTF-8, or a backslash or space at its end"
        raise UsageError(f"{path}: {what}", remedy="rename the folder")
    return text.replace("%", "%%")


def _in_quotes(path: Path) -> str:
    """Return a path for ReadWritePaths, which has quotes but keeps backslashes."""
    text = _bare(path)
    quote = next((one for one in "\"'" if one not in text), None)
    if quote is None:
        raise UsageError(f"{path}: a unit cannot name it: both kinds of quotes", remedy="rename the folder")
    return f"{quote}{text}{quote}"


def _checked_user(user: str) -> str:
    if user and not USER_NAME.fullmatch(user):
        allowed = "allowed are letters, digits, dot, dash, underscore and @, at most 255"
        raise UsageError(
            f"--run-as {user!r} is no name of a user: {allowed}", remedy="name one that `getent passwd` lists"
        )
    return user


def check_name(name: str) -> str:
    """Return `name`; UsageError if a unit cannot be called so."""
    if not NAME.fullmatch(name):
        allowed = "allowed are letters, digits, dot, dash and underscore, at most 100"
        raise UsageError(f"--name {name!r}: {allowed}", remedy="choose a short name, such as lab")
    return name


def is_unit_of_ours(path: Path) -> bool:
    """Return whether `path` is a unit that `pans service install` has written."""
    return path.is_file() and path.stat().st_size <= UNIT_MAX_BYTES and path.read_bytes().startswith(MARK.encode())


def read_unit(path: Path) -> str:
    """Return the text of a unit of ours; UsageError for any other file, and if it is not there."""
    text = read_file(path, UNIT_MAX_BYTES).decode("utf-8", "replace")
    if not text.startswith(MARK):
        what = f"{path}: was not written by `pans service install`"
        raise UsageError(what, remedy="name another service with --name")
    return text


# ---- what a service sends to systemd ----


@dataclass(slots=True)
class ServiceRun:
    """What a service said: each line with its time, seconds since the start; and how it ended."""

    lines: list[tuple[float, str]] = field(default_factory=list)
    asked_s: float | None = None  # SIGTERM
    ended_s: float = 0.0
    exit_code: int | None = None  # None: it had to be killed
    errors: str = ""  # the end of its stderr

    def times_s(self, line: str) -> list[float]:
        """Return when the service said `line`, such as READY=1."""
        return [at_s for at_s, found in self.lines if found == line]

    def longest_silence_s(self) -> float:
        """Return the longest time between two signs of life, from READY to SIGTERM or the end."""
        ready_s, until_s = self.times_s("READY=1")[0], self.ended_s if self.asked_s is None else self.asked_s
        alive_s = [at_s for at_s in self.times_s("WATCHDOG=1") if ready_s <= at_s <= until_s]
        return max(after - before for before, after in pairwise([ready_s, *alive_s, until_s]))


def run_as_systemd(
    command: Sequence[str], folder: Path, *, watchdog_s: float, seconds: float, start_s: float, stop_s: float
) -> ServiceRun:
    """Run `command` in `folder` for `seconds` after it is ready, stop it with SIGTERM, and return what it said.

    It has `start_s` to be ready and `stop_s` to end, as systemd gives it. UsageError where there are no such sockets.
    """
    if not hasattr(socket, "AF_UNIX"):
        raise UsageError("systemd's notify protocol needs sockets of the family AF_UNIX", remedy="use Linux")
    run = ServiceRun()
    with ExitStack() as opened:
        place = opened.enter_context(tempfile.TemporaryDirectory(prefix="pans-notify-"))
        stderr = opened.enter_context(tempfile.TemporaryFile())
        manager = opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        manager.bind(address := f"{place}/notify")
        manager.settimeout(POLL_S)
        environment = {key: value for key, value in os.environ.items() if key not in NOT_THE_SERVICES}
        environment |= {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(round(watchdog_s * 1e6))}
        began_s, due_s = time.monotonic(), start_s
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr
        )
        opened.callback(process.wait)
        opened.callback(process.kill)
        while True:
            ended = process.poll() is not None
            try:
                said = manager.recv(4096).decode("utf-8", "replace")
                run.lines += [(time.monotonic() - began_s, line) for line in said.split("\n")]
            except TimeoutError:
                if ended:
                    break
            now_s = time.monotonic() - began_s
            if run.asked_s is None and (ready_s := run.times_s("READY=1")):
                due_s = ready_s[0] + seconds
            if now_s <= due_s or ended:
                continue
            if run.asked_s is not None:
                break
            run.asked_s, due_s = now_s, now_s + stop_s
            process.send_signal(signal.SIGTERM)
        run.ended_s, run.exit_code = time.monotonic() - began_s, process.returncode
        stderr.seek(max(0, stderr.tell() - 2000))
        run.errors = stderr.read().decode("utf-8", "replace")
    return run


# ---- the command ----


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    what = "install, show, verify or remove the unit; or write what Prometheus and Grafana need"
    add("action", metavar="ACTION", choices=tuple(OF_ACTION), help=what)
    add("--config", type=Path, metavar="FILE", help="options of the run (pans run --write-config)")
    add("--name", metavar="NAME", help="the unit is pans-NAME.service (default: the name of the file)")
    add("--folder", type=Path, metavar="DIR", help="where the run works (default: this folder)")
    add("--run-as", metavar="USER", help="whom the service runs as (default: the present user)")
    add("--watchdog-s", type=WATCHDOG.option, metavar="S", help="restart after S s of silence (default 20)")
    add("--user", action="store_true", help="a unit of the user's own manager, not of the system's")
    add("--unit-dir", type=Path, metavar="DIR", help="where units are (default: systemd's folder)")
    add("--start", type=START.option, metavar="S", help="verify: run it for S s and check what it sends to systemd")
    add("-o", "--out", type=Path, metavar="DIR", help="monitoring: the folder to write to")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    for option in sorted(set().union(*OF_ACTION.values()) - OF_ACTION[args.action]):
        if getattr(args, option) not in (None, False):
            name = option.replace("_", "-")
            raise UsageError(f"--{name} has no effect with `pans service {args.action}`", remedy="leave it out")
    if args.action == "monitoring":
        return _monitoring(args)
    remedies = {"config": "write the options to a file: pans run ... --write-config", "name": "name the service"}
    needed = "config" if args.action == "install" or (args.action == "show" and not args.name) else "name"
    if getattr(args, needed) is None:
        raise UsageError(f"`pans service {args.action}` needs --{needed}", remedy=remedies[needed])
    name = check_name(args.name or args.config.stem)
    folder = args.unit_dir or (USER_UNITS.expanduser() if args.user else SYSTEM_UNITS)
    return _ACTIONS[args.action](args, name, folder / f"pans-{name}.service")


def _unit(args: argparse.Namespace, name: str) -> tuple[str, list[Path]]:
    """Return the text of the unit that the options ask for, and the folders that its run writes to."""
    folder, config = (args.folder or Path.cwd()).resolve(), args.config.resolve()
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder", remedy="make it first")
    writes = sorted({*_written_folders(config, folder)})
    command = (sys.executable, "-m", "pans", "run", "--config", str(config))
    needed = (folder, config, Path(sys.executable), *writes)
    hidden = [path for path in needed if any(path.is_relative_to(private) for private in PRIVATE)]
    if hidden and not args.user:
        what = f"{hidden[0]}: a service of the system sees no files of others in /tmp and /var/tmp (PrivateTmp)"
        raise UsageError(what, remedy="move it, for example to /srv, or install a unit of your own manager with --user")
    user = "" if args.user else args.run_as or os.environ.get("SUDO_USER") or getpass.getuser()
    return unit_text(name, command, folder, writes, args.watchdog_s or 20.0, user), writes


def _written_folders(config: Path, folder: Path) -> Iterator[Path]:
    """Yield the folders that the run of these options writes to, seen from `folder`; the options are checked as a run checks them."""
    run = load_command(find_commands()["run"])
    parser = parser_of("run", run)
    assert run.prepare is not None
    options = parser.parse_args(run.prepare(parser, ["--config", str(config)]))
    if options.seconds or options.decisions:
        warn(f"{config.name} ends the run by itself (seconds, decisions); a service that ends so is not started again")
    for name in ("out", "record"):
        if getattr(options, name) is not None:
            warn(f"{config.name} has `{name}`: a second start is refused, as the files of the first are there")
    if not options.keep_runs_mb:
        warn(f"{config.name} has no `keep-runs-mb`: each restart leaves another folder of recordings")
    yield folder / RUNS if options.out is None and options.record is None else folder
    for name in ("record", "state", "trace", "log_file"):
        if (path := getattr(options, name)) is not None:
            yield (folder / path).parent
    if options.out is not None:
        yield folder / options.out


def _show(args: argparse.Namespace, name: str, path: Path) -> int:
    text = read_unit(path) if args.config is None else _unit(args, name)[0]
    emit(args, {"unit": str(path), "text": text}, text.rstrip("\n"))
    return EXIT_FINE


def _install(args: argparse.Namespace, name: str, path: Path) -> int:
    text, writes = _unit(args, name)
    check_outputs([path], inputs=[args.config], force=args.force, ours=is_unit_of_ours, makes_folders=True)
    for place in (path.parent, *writes):  # a unit's ReadWritePaths must exist
        make_folder(place)
    write_file(path, text.encode(), force=True)
    command, folder = command_of(text)
    manager = _manager(args)
    following = [f"{manager} daemon-reload", f"{manager} enable --now {path.name}"]
    payload = {"unit": str(path), "command": command, "folder": str(folder), "next": following}
    return _judge(args, path, [_analysed(path, user=args.user)], payload)


def _verify(args: argparse.Namespace, name: str, path: Path) -> int:
    text = read_unit(path)
    command, folder = command_of(text)
    there = Path(command[0]).is_file() and folder.is_dir()
    findings = [
        _analysed(path, user=args.user),
        _finding("command and folder", there, f"{command[0]} in {folder}", "install the unit again"),
    ]
    if args.start is not None and there:
        watchdog_s = float(text.partition("\nWatchdogSec=")[2].partition("\n")[0])
        say(f"starting {path.name} for {args.start:g} s ...")
        every_s = min(watchdog_s, args.start / 3)  # a run sends three messages in that time: nine in all
        findings += _start_findings(
            run_as_systemd(command, folder, watchdog_s=every_s, seconds=args.start, start_s=START_S, stop_s=STOP_S),
            watchdog_s,
        )
    last = _last_run(command, folder)
    return _judge(args, path, findings, {"unit": str(path), "last_run": None if last is None else last.as_json()}, last)


def _last_run(command: list[str], folder: Path) -> Run | None:
    """Return the latest run of the service that has ended; None before the first one."""
    runs = runs_in(folder / RUNS) if (folder / RUNS).is_dir() else []
    line = shlex.join(["pans", *command[command.index("run") :]])
    return next((run for run in runs if run.command == line and not run.locked), None)


def _remove(args: argparse.Namespace, name: str, path: Path) -> int:
    read_unit(path)
    with refusing(f"{path}: cannot be removed", "run it as its owner"):
        path.unlink()
    following = [f"{_manager(args)} disable --now {path.name}", f"{_manager(args)} daemon-reload"]
    emit(args, {"removed": str(path), "next": following}, f"{path} is removed\nnext: {' && '.join(following)}")
    return EXIT_FINE


_ACTIONS = {"show": _show, "install": _install, "verify": _verify, "remove": _remove}


def _monitoring(args: argparse.Namespace) -> int:
    if args.out is None:
        raise UsageError("`pans service monitoring` needs a folder", remedy="name one with --out")
    paths = [args.out / name for name in MONITORING]
    check_outputs(paths, force=args.force, makes_folders=True)
    make_folder(args.out)
    for path in paths:
        write_file(path, (SHIPPED / path.name).read_bytes(), force=args.force)
    following = 'next: let Prometheus scrape "127.0.0.1:9464", and run with --metrics 127.0.0.1:9464'
    emit(args, {"files": [str(path) for path in paths]}, "\n".join([*map(str, paths), following]))
    return EXIT_FINE


def _manager(args: argparse.Namespace) -> str:
    return "systemctl --user" if args.user else "systemctl"


# ---- findings ----


def _analysed(path: Path, *, user: bool) -> dict[str, Any]:
    """Return what `systemd-analyze verify` finds wrong with the unit, or that it is not there."""
    program = shutil.which("systemd-analyze")
    if program is None:
        return _finding("systemd-analyze", True, "not installed: the unit's directives were not checked", "")
    words = [program, *(["--user"] if user else []), "--man=no", "verify", str(path)]
    env = {"XDG_RUNTIME_DIR": str(path.parent.resolve()), **os.environ}  # over ssh or as root a session may have none
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=ANALYZE_S, env=env)
    except (OSError, subprocess.TimeoutExpired) as error:
        return _finding("systemd-analyze", False, f"could not be asked: {error}", f"run it by hand: {' '.join(words)}")
    said = [line for line in done.stderr.splitlines() if path.name in line or done.returncode]
    fine = not said and done.returncode == 0
    return _finding("systemd-analyze", fine, "; ".join(said) or "no complaints", "install the unit again")


def _start_findings(run: ServiceRun, watchdog_s: float) -> Iterator[dict[str, Any]]:
    """Yield what is to be said of one start, of the protocol's four parts."""
    last = run.errors.strip().rsplit("\n", 1)[-1]
    ready_s, said, stops = (run.times_s(f"{word}=1") for word in ("READY", "WATCHDOG", "STOPPING"))
    if not ready_s:
        yield _finding("READY", False, f"not within {START_S} s, or the run ended: {last}", "start the run by hand")
        return
    yield _finding("READY", True, f"after {ready_s[0]:.1f} s", "")
    silence_s = run.longest_silence_s()
    found = f"{len(said)} messages, {silence_s:.2f} s apart at most, allowed {watchdog_s:g} s"
    lives = bool(said) and silence_s < watchdog_s
    yield _finding("WATCHDOG", lives, found, "the machine is too slow, or the watchdog's time too short: --watchdog-s")
    found = "said" if stops else "not said before the process ended"
    yield _finding("STOPPING", bool(stops), found, "look into its log")
    ended = f"exit code {run.exit_code}" if run.exit_code is not None else f"not within {STOP_S} s of SIGTERM"
    ended += "" if run.asked_s is not None else ", by itself"
    ran = run.exit_code in RAN
    if not ran:
        ended += f": {last}"
    elif run.exit_code != EXIT_FINE:
        ended += ": the service starts, runs and stops; the verdict of this run is FAIL"
    yield _finding("end", ran, ended[:400], "look into its log")


def _finding(check: str, ok: bool, found: str, remedy: str) -> dict[str, Any]:
    return {"check": check, "ok": ok, "found": found, "remedy": "" if ok else remedy}


def _judge(
    args: argparse.Namespace,
    path: Path,
    findings: list[dict[str, Any]],
    payload: dict[str, Any],
    last: Run | None = None,
) -> int:
    """Print the findings and what came of the `last` run; return the exit code, which the findings alone decide."""
    lines = [str(path)]
    for one in findings:
        lines.append(f"  {'ok' if one['ok'] else 'WRONG':<6} {one['check']}: {one['found']}")
        lines += [f"         remedy: {one['remedy']}"] if one["remedy"] else []
    if last is not None:
        begun = last.started.astimezone().strftime("%Y-%m-%d %H:%M")
        lines.append(f"  last run begun {begun}: {one_line(last.verdict)} ({last.folder})")
        lines += [f"         fault: {one_line(fault)}" for fault in last.faults]
    lines += [f"next: {line}" for line in payload.get("next", ())]
    emit(args, payload | {"findings": findings}, "\n".join(lines))
    return EXIT_FINE if all(one["ok"] for one in findings) else EXIT_ALERT


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
