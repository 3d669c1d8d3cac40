"""Bars: on the terminal while a command reads a long file (`replay`, `verify`, `report`, `info`, `export`, `compare`), and of any work.

There is none for a pass over a file that ends within a second, for a command whose standard error is no terminal, and with `--quiet`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pans.base.files.container import watching_blocks

from .printing import state
from .text import html

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
        self._shown = ExitStack()
        self._report: Callable[[float], None] | None = None

    def passed(self, path: str, number: int, done: int, total: int) -> None:
        """Take a step of a pass: see container.watching_blocks."""
        now_s = self._now_s()
        began_s = self._began.setdefault(number, now_s)
        if number != self._number:
            if self._report is not None and now_s - self._heard_s < GIVEN_UP_AFTER_S:
                return
            self.close()
            self._number = number
        self._heard_s = now_s
        if done >= total:
            self.close()
        elif now_s - max(began_s + SHOWN_AFTER_S - DRAWN_EVERY_S, self._drawn_s) >= DRAWN_EVERY_S:
            if self._report is None:
                bar = progress_bar(f"reading {Path(path).name}", total, threaded=False)
                self._report = self._shown.enter_context(bar)
            self._report(done)
            self._drawn_s = now_s

    def close(self) -> None:
        """Take the bar off the screen."""
        self._shown.close()
        self._report = None
        self._began.pop(self._number, None)


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
    with _terminal_bar(threaded=threaded) as report:
        yield lambda done: report(what, done / total)


@contextmanager
def work_bar() -> Iterator[Callable[[str, float], None]]:
    """Yield a call that displays, on a terminal or in a notebook, what is being done and which part of it is done, 0 to 1."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if shell is None or not hasattr(shell, "kernel"):
        with _terminal_bar() as report:
            yield report
        return
    line, drawn_s = _NotebookLine(), 0.0

    def draw(what: str, part: float) -> None:
        nonlocal drawn_s
        if time.monotonic() - drawn_s >= DRAWN_EVERY_S:
            line.draw(f'<progress value="{part:.3f}" max="1"></progress> {html(what)}')
            drawn_s = time.monotonic()

    try:
        yield draw
    finally:
        line.draw("")


class _NotebookLine:
    """A line of HTML below a notebook's cell, which is drawn again and again."""

    def __init__(self) -> None:
        from IPython import display

        untyped: Any = display
        self._handle = untyped.display({"text/html": "", "text/plain": ""}, raw=True, display_id=True)

    def draw(self, text: str) -> None:
        self._handle.update({"text/html": text, "text/plain": ""}, raw=True)


@contextmanager
def _terminal_bar(*, threaded: bool = True) -> Iterator[Callable[[str, float], None]]:
    if state.quiet or not sys.stderr.isatty():
        yield lambda what, part: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    text = TextColumn("{task.description}", markup=False)
    columns = (text, BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=threaded) as progress:
        task = progress.add_task("", total=1.0)
        yield lambda what, part: progress.update(task, description=what, completed=min(part, 1.0), refresh=not threaded)
