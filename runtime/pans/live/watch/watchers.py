"""What watches one run alongside its loop: state file, metrics, messages to systemd, the computer around it, the watchdog's facts.

All of it is started before the loop asks for real-time privileges, so that none of its threads inherits them.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from pans.base.console import one_line

from .host import HostWatch
from .state_file import Repeated, StateFile, is_stalled, picture_of, read_state

if TYPE_CHECKING:
    from pans.live.options import RunOptions
    from pans.live.status import Status
    from pans.live.stop import Stop
    from pans.record.recorder import Recorder

    from .metrics import MetricsServer
    from .watchdog import Watchdog

NOTIFY_EVERY_S = 1.0  # without WATCHDOG_USEC
NOTIFICATIONS_PER_TIMEOUT = 3
VERDICTS = ("PASS", "FAIL")
MAX_FAULTS = 20  # of the state file; the recording has them all


@dataclass
class Watchers:
    """State file, metrics and messages of one run; enter before it, `prepared` when it is there."""

    _wanted: RunOptions
    _recorder: Recorder | None
    _watchdog: Watchdog | None
    _stop: Stop
    _metrics: MetricsServer | None
    _host: HostWatch | None = None
    _run: Status | None = None
    _state: StateFile | None = None
    _notifier: Notifier | None = None
    _started_s: float = field(default_factory=time.monotonic)
    _outcome: dict[str, Any] = field(default_factory=dict)
    _open: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            self._host = HostWatch(self._recorder, self._wanted.stop_below, self._stop.request)
            opening.callback(self._host.close)
            if self._metrics is not None:
                self._metrics.look = self.look
            if self._wanted.state is not None:
                if (before := read_state(self._wanted.state)) is not None:  # one that was killed has no verdict
                    folder = Path(str(before.get("recording", ""))).parent.name
                    verdict = before.get("verdict")
                    self._outcome = {"last_verdict": verdict if verdict in VERDICTS else "cut", "last_folder": folder}
                self._state = StateFile(self._wanted.state, self.look)
                opening.callback(self._state.close)
            self._notifier = Notifier.of_environment()
            if self._notifier is not None:
                opening.callback(self._notifier.close)
            self._open = opening.pop_all()
        if self._watchdog is not None:
            self._watchdog.recorder, self._watchdog.note = self._recorder, self._note_end
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._watchdog is not None:
            self._watchdog.closes = True
        try:
            if self._run is not None and error is None:
                self.note_news(self._run)  # the recording is still open
                if self._recorder is not None:
                    self._recorder.flush()  # the last state names all decisions
            if error is not None:
                self._end_by(error)
        except BaseException as failure:
            self._end_by(failure)
            raise
        finally:
            self._open.close()

    def _end_by(self, error: BaseException) -> None:
        """State that the run has ended by an error: it did not come to a verdict, and is not running any more."""
        why = one_line(str(error) or type(error).__name__, 300)
        ended = {"state": "stopped", "ended": why}
        if self._run is not None:
            self.conclude("FAIL", [why])
        self._outcome |= ended

    def prepared(self, run: Status) -> None:
        """Watch `run` from here on."""
        self._run = run
        if self._watchdog is not None:
            self._watchdog.run = run
        if self._notifier is not None:
            self._notifier.begin(run)

    def conclude(self, verdict: str, faults: Sequence[str]) -> None:
        """State what came of the run: PASS or FAIL, and why."""
        folder = "" if self._recorder is None else self._recorder.open_file.path.parent.name
        self._outcome = {"verdict": verdict, "faults": [*faults][:MAX_FAULTS]}
        self._outcome |= {"last_verdict": verdict, "last_folder": folder}

    def look(self) -> dict[str, Any]:
        """Return the picture as it is now."""
        facts = {} if self._host is None else self._host.facts
        return picture_of(self._run, self._recorder, self._started_s) | facts | self._outcome

    def note_news(self, run: Status) -> None:
        """Note in the journal of `run` what was found about the computer; called by the loop."""
        while self._host is not None and self._host.news:
            run.accounts.journal.note(**self._host.news.popleft())

    def _note_end(self, why: str) -> None:
        """The watchdog ends the process."""
        if self._state is not None:
            self._state.leave({"state": "stalled", "ended": why})


class Notifier:
    """Messages to systemd (sd_notify(3)): READY when the run is prepared, WATCHDOG while the loop turns, STOPPING at the end.

    For a loop that is stuck nothing is sent, and systemd's WatchdogSec= ends the service.
    """

    def __init__(self, address: str, every_s: float) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._every_s = every_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._thread: Repeated | None = None

    @classmethod
    def of_environment(cls) -> Notifier | None:
        """Return the one that NOTIFY_SOCKET and WATCHDOG_USEC ask for, None without."""
        address, microseconds = os.environ.get("NOTIFY_SOCKET", ""), os.environ.get("WATCHDOG_USEC", "")
        if not address or not hasattr(socket, "AF_UNIX"):
            return None
        known = microseconds.isdecimal() and 0 < int(microseconds) < 1 << 62
        return cls(address, int(microseconds) / 1e6 / NOTIFICATIONS_PER_TIMEOUT if known else NOTIFY_EVERY_S)

    def begin(self, run: Status) -> None:
        """Say that the service is ready, and from here on that the loop of `run` turns."""
        self._send("READY=1")

        def send_watchdog() -> None:
            if run.ended or not is_stalled(run):
                self._send("WATCHDOG=1")

        send_watchdog()
        self._thread = Repeated("pans-systemd", self._every_s, send_watchdog)

    def close(self) -> None:
        """Say that the service stops."""
        if self._thread is not None:
            self._thread.close()
        self._send("STOPPING=1")
        self._socket.close()

    def _send(self, message: str) -> None:
        with suppress(OSError):  # nobody listens: a run does not end because of that
            self._socket.sendto(message.encode(), self._address)
