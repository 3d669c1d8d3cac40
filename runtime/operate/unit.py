"""systemd units for runs: their text, where they lie, and the way back from a unit to the command that it starts.

Owns the directives and systemd's quoting (systemd.service(5), systemd.syntax(7)); never talks to systemd. A unit of ours begins with
MARK; others are never replaced or removed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pans.runtime.container import read_file
from pans.runtime.errors import UsageError
from pans.runtime.timing.ledger import FIFO_PRIORITY

MARK = "# Written by `pans service install`; change the file of options, not this one."
SYSTEM_UNITS, USER_UNITS = Path("/etc/systemd/system"), Path("~/.config/systemd/user")
UNIT_MAX_BYTES = 1 << 16
START_S = 180  # kernels are compiled once, on a slow machine for a minute
STOP_S = 45  # the watchdog ends a stuck run within 5 s; a slow disk has 30 s to sync
RESTART_S = 5
NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")
_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r", "%": "%%"}


@dataclass(frozen=True, slots=True)
class Service:
    """What a unit is written for; `writes` are the folders that the run writes to, all paths absolute."""

    name: str
    command: tuple[str, ...]
    folder: Path
    writes: tuple[Path, ...]
    watchdog_s: float
    user: str = ""  # whom a unit of the system runs as; "" in a unit of a user's own manager

    @property
    def file_name(self) -> str:
        """The name of the unit."""
        return f"pans-{self.name}.service"


def unit_text(service: Service) -> str:
    """Return the unit."""
    return "\n".join([MARK, *_lines(service)]) + "\n"


def _lines(service: Service) -> Iterator[str]:
    yield from ("[Unit]", f"Description=pans run, {service.name}", "After=network.target local-fs.target")
    yield from ("StartLimitIntervalSec=600", "StartLimitBurst=10", "", "[Service]")
    yield from ("Type=notify", "NotifyAccess=main", f"WatchdogSec={service.watchdog_s:g}")
    yield from (f"ExecStart={command_line(service.command)}", f"WorkingDirectory={_escaped(str(service.folder))}")
    if service.user:
        yield f"User={service.user}"
    yield from ("Restart=on-failure", f"RestartSec={RESTART_S}")
    yield "# 2: the options or a file are wrong, or the disk is full; starting again would not mend that"
    yield "RestartPreventExitStatus=2"
    yield from (f"TimeoutStartSec={START_S}", f"TimeoutStopSec={STOP_S}", "KillMode=mixed")
    yield from ("", "# real time: the loop asks for SCHED_FIFO and locks its memory")
    yield from (f"LimitRTPRIO={FIFO_PRIORITY}", "LimitMEMLOCK=infinity", "LimitNOFILE=4096")
    yield from (
        "",
        "# compiled kernels, which cannot be kept beside the package",
        f"CacheDirectory=pans-{service.name}",
    )
    yield f"Environment=NUMBA_CACHE_DIR=%C/pans-{service.name}"
    yield from (
        "",
        "# hardening; MemoryDenyWriteExecute and RestrictRealtime would forbid compiled kernels and SCHED_FIFO",
    )
    yield from ("NoNewPrivileges=yes", "UMask=0027")
    if service.user:
        yield from _walls(service)
    yield from ("", "[Install]", f"WantedBy={'multi-user' if service.user else 'default'}.target")


def _walls(service: Service) -> Iterator[str]:
    """What only the system's manager can forbid everywhere."""
    yield from ("ProtectSystem=strict", "ProtectHome=read-only", "PrivateTmp=yes", "ProtectControlGroups=yes")
    yield from ("ProtectKernelTunables=yes", "ProtectKernelModules=yes", "ProtectKernelLogs=yes", "ProtectClock=yes")
    yield from (
        "RestrictNamespaces=yes",
        "RestrictSUIDSGID=yes",
        "LockPersonality=yes",
        "SystemCallArchitectures=native",
    )
    yield "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK"
    yield "# serial ports and USB devices, and no others"
    yield from ("DevicePolicy=closed", *(f"DeviceAllow={kind} rw" for kind in _DEVICES))
    yield from (f"ReadWritePaths={quoted(str(path))}" for path in sorted({service.folder, *service.writes}))


_DEVICES = ("char-ttyACM", "char-ttyUSB", "char-ttyS", "char-pts", "char-usb_device")


# ---- quoting ----


def _escaped(text: str) -> str:
    return "".join(_ESCAPES.get(letter, letter) for letter in text)


def quoted(text: str) -> str:
    """Return one word as a unit writes it: in quotes, with systemd's escapes and specifiers doubled."""
    return f'"{_escaped(text)}"'


def command_line(words: Sequence[str]) -> str:
    """Return the value of ExecStart for a command whose first word is an absolute path.

    >>> command_line(["/usr/bin/pans", "run", "50%.pans", "$HOME"])
    '"/usr/bin/pans" "run" "50%%.pans" "$$HOME"'
    """
    return " ".join(quoted(word).replace("$", "$$") for word in words)


def command_of(text: str) -> tuple[list[str], Path]:
    """Return the command and the working directory of the unit `text`, which is one of ours; UsageError if they are not there."""
    values = {key: value for key, _, value in (line.partition("=") for line in text.split("\n"))}
    words = [_unescaped(found) for found in re.findall(r'"((?:[^"\\]|\\.)*)"', values.get("ExecStart", ""))]
    folder = _unescaped(values.get("WorkingDirectory", ""))
    if not words or not folder:
        raise UsageError("the unit has no ExecStart or no WorkingDirectory", remedy="install it again")
    return [word.replace("$$", "$") for word in words], Path(folder)


def _unescaped(text: str) -> str:
    letters = {"n": "\n", "t": "\t", "r": "\r"}
    return re.sub(r"\\(.)", lambda found: letters.get(found[1], found[1]), text.replace("%%", "%"))


# ---- files ----


def units_folder(given: Path | None, *, user: bool) -> Path:
    """Return where units lie: `given`, else the folder of the system's or of the user's manager."""
    return given or (USER_UNITS.expanduser() if user else SYSTEM_UNITS)


def check_name(name: str) -> str:
    """Return `name`; UsageError if a unit cannot be called so."""
    if not NAME.fullmatch(name):
        raise UsageError(
            f"--name {name!r}: allowed are letters, digits, dot, dash and underscore, at most 100",
            remedy="choose a short name, such as lab",
        )
    return name


def is_unit_of_ours(path: Path) -> bool:
    """Return whether `path` is a unit that `pans service install` has written."""
    return path.is_file() and path.stat().st_size <= UNIT_MAX_BYTES and path.read_bytes().startswith(MARK.encode())


def read_unit(path: Path) -> str:
    """Return the text of a unit of ours; UsageError for any other file, and if it is not there."""
    text = read_file(path, UNIT_MAX_BYTES).decode("utf-8", "replace")
    if not text.startswith(MARK):
        raise UsageError(
            f"{path}: was not written by `pans service install`", remedy="name another service with --name"
        )
    return text
