"""The live view: what is happening, for people, while the loop runs; plain lines where there is no terminal.

Owns the screen and how often it is drawn; never computes a figure. It draws right after a block, at most a few times per second: a panel
where the deadline leaves time for that, else a line, which takes 0.1 ms. `live_view` yields the watcher that the loop calls.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pans.runtime.cli import say
from pans.runtime.core.decision import NO_LABEL, Decision, Output
from pans.runtime.safe_text import lines, one_line

from .run import LiveRun, Watcher

if TYPE_CHECKING:
    from rich.console import RenderableType

DRAW_EVERY_S = 0.25
LINE_EVERY_S = 5.0
LAST_DECISIONS = 8
PANEL_DEADLINE_US = 15_000.0  # drawing it takes 7 ms, the first time 20


@contextmanager
def live_view(
    title: str, classes: Sequence[str], expected: int, simulated: bool, deadline_us: float
) -> Iterator[Watcher]:
    """Show a run of `expected` decisions (0: unknown) on stderr: a rich panel on a terminal, else a line every few seconds.

    The loop draws it, so there is no panel where it alone would make decisions late.
    """
    from rich.console import Console

    console = Console(stderr=True)
    banner = f"SIMULATED · {title}" if simulated else title
    if not console.is_terminal or deadline_us < PANEL_DEADLINE_US:
        yield _Lines(banner, expected).watch
        return
    from rich.live import Live

    panel = _Panel(banner, classes, expected)
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def watch(run: LiveRun, output: Output) -> None:
            if panel.take(run, output):
                live.update(panel.render(run), refresh=True)

        yield watch


class _Lines:
    """One plain line every few seconds, written without rich, whose first line takes the loop 2.8 ms."""

    def __init__(self, banner: str, expected: int) -> None:
        self._banner, self._expected, self._due_s = banner, expected, time.monotonic() + LINE_EVERY_S

    def watch(self, run: LiveRun, output: Output) -> None:
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + LINE_EVERY_S
        say(f"{self._banner}: {_headline(run, self._expected)}")


class _Panel:
    """Figures, the latest decisions and how sure they were."""

    def __init__(self, banner: str, classes: Sequence[str], expected: int) -> None:
        self._banner, self._classes, self._expected = banner, classes, expected
        self._latest: deque[Decision] = deque(maxlen=LAST_DECISIONS)
        self._due_s = 0.0

    def take(self, run: LiveRun, output: Output) -> bool:
        self._latest.extend(output.decisions)
        if not output.decisions or time.monotonic() < self._due_s:
            return False
        self._due_s = time.monotonic() + DRAW_EVERY_S
        return True

    def render(self, run: LiveRun) -> RenderableType:
        from rich.console import Group
        from rich.panel import Panel
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        table = Table("object", "decision", "sure", "clicks", "truth", box=None, padding=(0, 2, 0, 0))
        for decision in self._latest:
            known = 0 <= decision.truth < len(self._classes)
            style = "" if not known else "green" if decision.truth == decision.label else "red"
            table.add_row(
                str(decision.object),
                Text(one_line(name_of(decision.label, self._classes), 40), style=style),
                f"{decision.probability:4.0%}",
                f"{'●' * min(decision.clicks, 20)} {decision.clicks}",
                Text(one_line(self._classes[decision.truth], 40)) if known else "?",
            )
        bar = ProgressBar(total=self._expected or None, completed=run.tally.decisions, width=60)
        return Panel(
            Group(Text(lines(_headline(run, self._expected))), bar, Text(""), table),
            title=Text(one_line(self._banner, 70)),
            width=84,
        )


def name_of(label: int, classes: Sequence[str]) -> str:
    """Return the class name of a label, "abstained" for none."""
    if label == NO_LABEL:
        return "abstained"
    return classes[label] if classes else "picture"


def _headline(run: LiveRun, expected: int) -> str:
    tally, timing = run.tally, run.timing
    accuracy = "" if tally.accuracy is None else f" · accuracy {tally.accuracy:.1%}"
    clicks = tally.clicks / tally.decisions if tally.decisions else 0.0
    return (
        f"{tally.decisions}{f' of {expected}' if expected else ''} decisions{accuracy} · {clicks:.2f} clicks each"
        f" · p99 {timing.total.quantile_ns(0.99) / 1e6:.2f} ms · late {timing.late}"
        f" · lost {run.core.tracker.counters.lost_exposures}{_dark(run)}"
    )


def _dark(run: LiveRun) -> str:
    """What is wrong with the dark counts, if anything."""
    guard = getattr(run.core, "guard", None)
    words = "" if guard is None else guard.words()
    return f" · dark counts: {words}" if words else ""
