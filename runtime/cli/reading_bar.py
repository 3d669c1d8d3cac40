"""Bars on the terminal: while a command reads a long file (`replay`, `verify`, `report`, `info`, `export`, `compare`), and of any work.

There is none for a pass over a file that ends within a second, for a command whose standard error is no terminal, and with `--quiet`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pans.runtime.container import watching_blocks

from .printing import state

if TYPE_CHECKING:  # a command that answers at once does not load it
    from rich.progress import Progress, TaskID

SHOWN_AFTER_S = 1.0
DRAWN_EVERY_S = 0.2
GIVEN_UP_AFTER_S = 1.0  # a pass of which nothing is heard has ended in its middle; another one is shown


class ReadingBar:
    """Shows one pass at a time: the one that is shown, until it is over or nothing more is heard of it."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._began: dict[int, float] = {}
        self._number = 0
        self._heard_s = self._drawn_s = 0.0
        self._progress: Progress | None = None
        self._task: TaskID | None = None

    def passed(self, path: str, number: int, done: int, total: int) -> None:
        """Take a step of a pass: see container.watching_blocks."""
        now_s = self._now_s()
        began_s = self._began.setdefault(number, now_s)
        if number != self._number:
            if self._progress is not None and now_s - self._heard_s < GIVEN_UP_AFTER_S:
                return
            self.close()
            self._number = number
        self._heard_s = now_s
        if done >= total:
            self.close()
        elif now_s - max(began_s + SHOWN_AFTER_S - DRAWN_EVERY_S, self._drawn_s) >= DRAWN_EVERY_S:
            self._draw(path, done, total)
            self._drawn_s = now_s

    def close(self) -> None:
        """Take the bar off the screen."""
        if self._progress is not None:
            self._progress.stop()
        self._progress = self._task = None
        self._began.pop(self._number, None)

    def _draw(self, path: str, done: int, total: int) -> None:
        if self._progress is None:
            from rich.console import Console
            from rich.markup import escape
            from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

            columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
            self._progress = Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False)
            self._task = self._progress.add_task(escape(f"reading {Path(path).name}"), total=total)
            self._progress.start()
        assert self._task is not None
        self._progress.update(self._task, completed=done, refresh=True)


@contextmanager
def reading_bar() -> Iterator[None]:
    """Show how far long files have been read within the block, where somebody looks."""
    if state.quiet or not sys.stderr.isatty():
        yield
        return
    bar = ReadingBar()
    try:
        with watching_blocks(bar.passed):
            yield
    finally:
        bar.close()


@contextmanager
def progress_bar(what: str, total: float, *, threaded: bool = True) -> Iterator[Callable[[float], None]]:
    """Yield a call that displays on a terminal how much of `total` is done; `threaded` draws in a thread of its own."""
    if state.quiet or not sys.stderr.isatty():
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=threaded) as progress:
        task = progress.add_task("", total=total)
        yield lambda done: progress.update(task, completed=min(done, total), refresh=not threaded)
