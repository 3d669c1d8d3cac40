"""The live view of one run: a thread that takes pictures of it, and the process that draws them.

The loop hands over its decisions (one call per block) and waits for nothing: a drawing process that hangs or dies only stops drawing.
Without a terminal and without a page there is no process, only a plain line now and then.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from importlib.util import find_spec
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self

from pans.base.console import missing_extra, one_line, say
from pans.base.errors import UsageError

if TYPE_CHECKING:
    from pans.bundle.sensor import Bundle
    from pans.decide import Decision, Output
    from pans.live.loop import Status
    from pans.live.stop import Stop

    from .snapshot import Snapshots

EVERY_S = 0.4
NOTE_CHARACTERS, NOTES_WAITING = 200, 20
KEPT_DECISIONS = 64
LINE_EVERY_S = 5.0
GOODBYE_S = 3.0
BACKLOG = 64


class Monitor:
    """Shows one run: with `panel` in the terminal, with `address` (HOST:PORT) as a web page, else in plain lines unless not `lines`.

    With `control` the page can stop the run and put notes into the recording. Enter it before anything long begins, so that the page is
    there and a busy port is refused at once (UsageError); `begin` before the run, `prepared` when the run is there, `watch` after each
    block, `close_notes` before the recording is closed.
    """

    def __init__(self, *, panel: bool, address: str = "", control: bool = False, lines: bool = True) -> None:
        self._panel, self._address, self._control, self._lines = panel, address, control, lines and not panel
        self._child: subprocess.Popen[str] | None = None
        self._snapshots: Snapshots | None = None
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._latest: deque[Decision] = deque(maxlen=KEPT_DECISIONS)
        self._notes: deque[dict[str, Any]] = deque(maxlen=NOTES_WAITING)
        self._stop: Stop | None = None
        self._run: Status | None = None
        self.url = ""

    def __enter__(self) -> Self:
        words = ["--panel"] if self._panel else []
        if not self._address:
            if words:
                self._start(words)
            return self
        from pans.live.watch import is_loopback, parse_address  # the server's modules load slowly

        for name in ("bokeh", "jinja2"):
            with suppress(ModuleNotFoundError):
                if find_spec(name) is not None:
                    continue
            raise missing_extra("--serve", name, "ui")
        host, port = parse_address(self._address, "--serve")
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            listening = socket.create_server((host, port), family=family, backlog=BACKLOG)
        except OSError as error:
            why = f"--serve {self._address}: cannot listen there: {error.strerror or error}"
            raise UsageError(why, remedy="choose another port") from error
        with listening:
            words += ["--serve", str(listening.fileno()), *(["--local"] if is_loopback(host) else [])]
            self._start(words + ["--control"] * self._control, listening.fileno())
            self.url = f"http://{f'[{host}]' if ':' in host else host}:{listening.getsockname()[1]}/"
        return self

    def _start(self, words: list[str], *handles: int) -> None:
        command = [sys.executable, "-P", "-m", "pans.report.live_view.child", *words]
        pipe = subprocess.PIPE
        self._child = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, pass_fds=handles)
        threading.Thread(target=self._listen, args=(self._child.stdout,), name="pans-page", daemon=True).start()

    def begin(self, facts: dict[str, Any], stop: Stop) -> None:
        """Start to take pictures, in a thread that inherits no privileges of the loop.

        `facts` are what is known before a run: title, classes, encoder, simulated, expected decisions, deadline_us and others.
        """
        self._stop = stop
        if self._child is not None or self._lines:
            self._thread = threading.Thread(target=self._keep, args=(facts,), name="pans-monitor", daemon=True)
            self._thread.start()

    def prepared(self, run: Status, bundle: Bundle, look: Callable[[], dict[str, Any]]) -> None:
        """Show `run` from here on, and what `look` returns of it (watch.state_file)."""
        from .snapshot import Snapshots

        self._run = run
        self._snapshots = Snapshots(run, bundle, self._latest, look, words=bool(self.url))

    def watch(self, run: Status, output: Output) -> None:
        """Take the decisions of a block."""
        self._latest.extend(output.decisions[-KEPT_DECISIONS:])
        if self._notes:
            self.close_notes()

    def close_notes(self) -> None:
        """Note in the run's journal, and so in its recording, what was written on the page; called by the loop."""
        while self._notes and (run := self._run) is not None:
            tick = run.session.known_clock().to_tick(run.now_ns())
            run.accounts.journal.note("note", **self._notes.popleft(), tick=tick)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        if self._thread is not None:
            self._thread.join(GOODBYE_S)
        if self._child is None:
            return
        with suppress(OSError):  # the process draws what is left; one that does not end is ended
            if self._child.stdin is not None and (self._thread is None or not self._thread.is_alive()):
                self._child.stdin.close()
        try:
            self._child.wait(GOODBYE_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    # -- the threads ---------------------------------------------------------------------------------------------------

    def _keep(self, facts: dict[str, Any]) -> None:
        from .figures import headline, title_of
        from .history import History

        history = History()
        history.take(facts)
        told, line_due_s = self._tell(facts), time.monotonic() + LINE_EVERY_S
        over = False
        while not over:
            over = self._ending.wait(EVERY_S)
            if self._snapshots is None:
                continue
            try:
                picture = self._snapshots.take()
            except RuntimeError:  # a dict that grew while it was read: the next picture has it
                continue
            told = told and self._tell(picture)
            if self._lines:
                history.take(picture)
                if time.monotonic() >= line_due_s and not over:
                    line_due_s = time.monotonic() + LINE_EVERY_S
                    say(f"{title_of(history)}: {headline(history)}")

    def _listen(self, said: IO[str]) -> None:
        """Take what is asked for on the page: a note, or the end of the run."""
        with suppress(ValueError, OSError), said:  # the process is gone
            for line in said:
                asked = json.loads(line)
                text = one_line(asked.get("note", ""), NOTE_CHARACTERS).strip()
                utc = datetime.now(UTC).isoformat(timespec="milliseconds")
                if text:
                    self._notes.append({"text": text, "utc": utc})
                elif asked.get("stop") is True and self._stop is not None:
                    from pans.live.stop import INTERRUPTED  # the process that draws loads nothing of it

                    self._notes.append({"text": "stop was pressed on the live page", "utc": utc})
                    self._stop.request(INTERRUPTED)

    def _tell(self, message: dict[str, Any]) -> bool:
        with suppress(OSError, ValueError):  # it is gone: the run goes on without a view
            if self._child is not None and self._child.stdin is not None:
                self._child.stdin.write(json.dumps(message) + "\n")
                self._child.stdin.flush()
                return True
        return False


def load_drawing() -> None:
    """Load what a snapshot of a run needs; a run does so while its port opens."""
    from . import snapshot as snapshot
