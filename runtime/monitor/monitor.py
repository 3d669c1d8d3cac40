"""The live view of one run: a thread that takes pictures of it, and the process that draws them.

The loop hands over its decisions (one call per block) and waits for nothing: a drawing process that hangs or dies only stops drawing.
Without a terminal and without a page there is no process, only a plain line now and then.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from pans.runtime.cli import say
from pans.runtime.errors import UsageError

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle
    from pans.runtime.core.decision import Decision, Output
    from pans.runtime.live import LiveRun
    from pans.runtime.record import Recorder

    from .snapshot import Snapshots

EVERY_S = 0.4
LINE_EVERY_S = 5.0
GOODBYE_S = 3.0


class Monitor:
    """Shows one run: with `panel` in the terminal, with `address` (HOST:PORT) as a web page, else in plain lines unless not `lines`.

    Enter it before anything long begins, so that the page is there and a busy port is refused at once (UsageError); `begin` before the run,
    `prepared` when the run is there, `watch` after each block.
    """

    def __init__(self, *, panel: bool, address: str = "", lines: bool = True) -> None:
        self._words = [*(["--panel"] if panel else []), *(["--serve", address] if address else [])]
        self._address, self._lines = address, lines and not panel
        self._child: subprocess.Popen[str] | None = None
        self._snapshots: Snapshots | None = None
        self._facts: dict[str, Any] = {}
        self._wanted: tuple[Bundle, Recorder | None] | None = None
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._latest: deque[Decision] = deque(maxlen=12)
        self.url = ""

    def __enter__(self) -> Self:
        if self._words:
            command = [sys.executable, "-P", "-m", "pans.runtime.monitor.child", *self._words]
            self._child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        try:
            if self._address:
                self._wait_for_page()
        except BaseException:
            self._end_child()
            raise
        return self

    def _wait_for_page(self) -> None:
        assert self._child is not None
        assert self._child.stdout is not None
        said = json.loads(self._child.stdout.readline() or '{"error": "the drawing process did not start"}')
        if "error" in said:
            raise UsageError(
                f"--serve {self._address}: cannot listen there: {said['error']}", remedy="choose another port"
            )
        from pans.runtime.watch.metrics import parse_address  # the server's modules load slowly

        host = parse_address(self._address, "--serve")[0]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{said['port']}/"

    def begin(self, bundle: Bundle, recorder: Recorder | None, facts: dict[str, Any]) -> None:
        """Start to take pictures, in a thread that inherits no privileges of the loop; `facts` are begin_facts'."""
        self._wanted, self._facts = (bundle, recorder), facts
        if self._child is None and not self._lines:
            return
        self._thread = threading.Thread(target=self._keep, name="pans-monitor", daemon=True)
        self._thread.start()

    def prepared(self, run: LiveRun) -> None:
        """Show `run` from here on."""
        from .snapshot import Snapshots

        assert self._wanted is not None
        self._snapshots = Snapshots(run, *self._wanted, self._latest)

    def watch(self, run: LiveRun, output: Output) -> None:
        """Take the decisions of a block."""
        self._latest.extend(output.decisions[-(self._latest.maxlen or 0) :])

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        if self._thread is not None:
            self._thread.join(GOODBYE_S)
        self._end_child()

    # -- the thread ----------------------------------------------------------------------------------------------------

    def _keep(self) -> None:
        from .figures import headline, title_of
        from .history import History

        history = History()
        history.take(self._facts)
        told, line_due_s = self._tell(self._facts), time.monotonic() + LINE_EVERY_S
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

    def _tell(self, message: dict[str, Any]) -> bool:
        if self._child is None or self._child.stdin is None:
            return False
        try:
            self._child.stdin.write(json.dumps(message) + "\n")
            self._child.stdin.flush()
        except (OSError, ValueError):  # it is gone: the run goes on without a view
            return False
        return True

    def _end_child(self) -> None:
        """Let the process draw what is left; one that does not end is ended."""
        child, self._child = self._child, None
        if child is None:
            return
        with suppress(OSError):
            if child.stdin is not None and (self._thread is None or not self._thread.is_alive()):
                child.stdin.close()
        try:
            child.wait(GOODBYE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        if child.stdout is not None:
            child.stdout.close()
