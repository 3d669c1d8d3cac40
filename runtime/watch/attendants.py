"""What lives as long as a run does: state file, metrics, systemd's messages, the watch on the computer, the watchdog's facts.

Owns their beginning and end. They are started before the loop asks for real-time privileges, so that none of their threads inherits them.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from pans.runtime.live import LiveRun
    from pans.runtime.live.continuous import Stop
    from pans.runtime.live.run_options import RunOptions
    from pans.runtime.record import Recorder

    from .host import HostWatch
    from .metrics import MetricsServer
    from .state_file import StateFile
    from .systemd import Notifier
    from .watchdog import Watchdog


class Attendants:
    """State file, metrics and messages of one run; enter before it, `prepared` when it is there."""

    def __init__(
        self,
        wanted: RunOptions,
        recorder: Recorder | None,
        watchdog: Watchdog | None = None,
        stop: Stop | None = None,
        metrics: MetricsServer | None = None,
    ) -> None:
        self._wanted, self._recorder, self._watchdog, self._stop = wanted, recorder, watchdog, stop
        self._host: HostWatch | None = None
        self._run: LiveRun | None = None
        self._state: StateFile | None = None
        self._notifier: Notifier | None = None
        self._metrics = metrics
        self._started_s = time.monotonic()
        self._open = ExitStack()

    def __enter__(self) -> Self:
        from .host import HostWatch
        from .state_file import StateFile
        from .systemd import Notifier

        with ExitStack() as opening:
            ask = (lambda why: None) if self._stop is None else self._stop.request
            self._host = HostWatch(self._recorded, self._wanted.stop_below, ask, self._is_deleted)
            opening.callback(self._host.close)
            if self._metrics is not None:
                self._metrics.look = self.look
            if self._wanted.state is not None:
                self._state = StateFile(self._wanted.state, self.look)
                opening.callback(self._state.close)
            self._notifier = Notifier.of_environment()
            if self._notifier is not None:
                opening.callback(self._notifier.close)
            self._open = opening.pop_all()
        if self._watchdog is not None:
            self._watchdog.watch(self._recorder, self._told)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._watchdog is not None:
            self._watchdog.closes()
        try:
            if self._run is not None and error is None:
                self.tell(self._run)  # the recording is still open
                if self._recorder is not None:
                    self._recorder.flush()  # the last state names all decisions
        finally:
            self._open.close()

    def prepared(self, run: LiveRun) -> None:
        """Show `run` from here on."""
        self._run = run
        if self._watchdog is not None:
            self._watchdog.run = run
        if self._notifier is not None:
            self._notifier.begin(run)

    def look(self) -> dict[str, Any]:
        """Return the picture as it is now."""
        from .state_file import picture_of

        facts = {} if self._host is None else self._host.facts()
        return picture_of(self._run, self._recorder, self._started_s) | facts

    def tell(self, run: LiveRun) -> None:
        """Note in the journal of `run` what was found about the computer; called by the loop."""
        if self._host is not None:
            for event in self._host.news():
                run.journal.note(**event)

    def _recorded(self) -> Path | None:
        """Return the file that is being written."""
        recorder = self._recorder
        return None if recorder is None else recorder.open_path

    def _is_deleted(self) -> bool:
        return self._recorder is not None and self._recorder.is_deleted

    def _told(self, why: str) -> None:
        """The watchdog ends the process: leave word."""
        if self._state is not None:
            self._state.leave({"state": "stalled", "ended": why})
