"""Does a service speak systemd's notify protocol? Start it as systemd does, hear its messages on a real socket, stop it.

Owns the manager's side of sd_notify(3) for one start: NOTIFY_SOCKET, WATCHDOG_USEC, READY, WATCHDOG, SIGTERM, STOPPING. The device is
really started.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from pans.runtime.errors import UsageError

POLL_S = 0.05
NOT_THE_SERVICES = ("INVOCATION_ID", "JOURNAL_STREAM", "MAINPID")


@dataclass(slots=True)
class Heard:
    """What a service said, and when: seconds since its start."""

    ready_s: float | None = None
    watchdog_s: list[float] = field(default_factory=list)
    stopping_s: float | None = None
    asked_s: float | None = None  # SIGTERM
    ended_s: float = 0.0
    exit_code: int | None = None  # None: it had to be killed

    def take(self, message: str, at_s: float) -> None:
        """Note one datagram, which may hold several lines."""
        for line in message.split("\n"):
            if line == "READY=1" and self.ready_s is None:
                self.ready_s = at_s
            elif line == "WATCHDOG=1":
                self.watchdog_s.append(at_s)
            elif line == "STOPPING=1":
                self.stopping_s = at_s

    def longest_silence_s(self) -> float:
        """The longest time between two signs of life, from READY to SIGTERM or the end."""
        if self.ready_s is None:
            return float("inf")
        until = self.ended_s if self.asked_s is None else self.asked_s
        times = [self.ready_s, *(at for at in self.watchdog_s if self.ready_s <= at <= until), until]
        return max(after - before for before, after in pairwise(times))


def start_and_hear(
    command: Sequence[str], folder: Path, *, watchdog_s: float, seconds: float, start_s: float, stop_s: float
) -> tuple[Heard, str]:
    """Run `command` in `folder` for `seconds` after it is ready, stop it with SIGTERM, and return what it said, and its stderr's end.

    It has `start_s` to be ready and `stop_s` to end, as systemd gives it. UsageError where there are no such sockets.
    """
    if not hasattr(socket, "AF_UNIX"):
        raise UsageError("systemd's notify protocol needs sockets of the family AF_UNIX", remedy="use Linux")
    heard = Heard()
    with tempfile.TemporaryDirectory(prefix="pans-notify-") as place, tempfile.TemporaryFile() as stderr:
        address = str(Path(place) / "notify")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            manager.bind(address)
            manager.settimeout(POLL_S)
            said = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(round(watchdog_s * 1e6))}
            rest = {key: value for key, value in os.environ.items() if key not in NOT_THE_SERVICES}
            began_s = time.monotonic()
            process = subprocess.Popen(
                command, cwd=folder, env=rest | said, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr
            )
            try:
                _hear(heard, manager, process, began_s, seconds, (start_s, stop_s))
            finally:
                if process.poll() is None:
                    process.kill()
                    process.wait()
        stderr.seek(max(0, stderr.tell() - 2000))
        return heard, stderr.read().decode("utf-8", "replace")


def _hear(
    heard: Heard,
    manager: socket.socket,
    process: subprocess.Popen[bytes],
    began_s: float,
    seconds: float,
    limits_s: tuple[float, float],
) -> None:
    start_s, stop_s = limits_s
    for now_s in _until_ended(heard, manager, process, began_s):
        if heard.asked_s is not None:
            if now_s > heard.asked_s + stop_s:
                return
        elif now_s > (start_s if heard.ready_s is None else heard.ready_s + seconds):
            heard.asked_s = now_s
            process.send_signal(signal.SIGTERM)
    heard.exit_code = process.returncode


def _until_ended(
    heard: Heard, manager: socket.socket, process: subprocess.Popen[bytes], began_s: float
) -> Iterator[float]:
    """Yield the seconds since the start after each message or pause, until the process has ended and nothing is left to be heard."""
    while True:
        ended = process.poll() is not None
        try:
            heard.take(manager.recv(4096).decode("utf-8", "replace"), time.monotonic() - began_s)
        except TimeoutError:
            if ended:
                heard.ended_s = time.monotonic() - began_s
                return
        yield time.monotonic() - began_s
