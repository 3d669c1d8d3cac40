"""How a training goes, as it goes: a line or a bar with a small curve on the terminal, and the curves as pictures afterwards.

Owns what is shown on stderr while `pans train` works; never trains. A terminal gets a bar with a curve of every report so far, other
streams get a line at times.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise

from pans.runtime.cli import say

CURVE_WIDTH = 48
HISTORY_FILES = ("history.json", "curves.png", "evolution.png")
_BLOCKS = "▁▂▃▄▅▆▇█"

Show = Callable[
    [str, float, int, int, bool], None
]  # words, value of the curve, done, of how many, whether a line is due


def curve(values: Sequence[float], width: int = CURVE_WIDTH) -> str:
    """Return values as a row of blocks, the lowest and the highest at its ends; long ones are thinned to `width` means.

    >>> curve([1.0, 2.0, 4.0, 8.0])
    '▁▂▄█  1 to 8, now 8'
    """
    if not values:
        return ""
    columns = min(width, len(values))
    bounds = [len(values) * i // columns for i in range(columns + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in pairwise(bounds)]
    low, high = min(means), max(means)
    span = (high - low) or 1.0
    blocks = "".join(_BLOCKS[min(len(_BLOCKS) - 1, int(len(_BLOCKS) * (mean - low) / span))] for mean in means)
    return f"{blocks}  {low:.3g} to {high:.3g}, now {values[-1]:.3g}"


@contextmanager
def shown_course(quantity: str) -> Iterator[Show]:
    """Yield what takes every report; on a terminal a bar with remaining time and the curve of `quantity`, else lines."""
    if not sys.stderr.isatty():
        yield lambda words, _value, _done, _steps, due: say(words) if due else None
        return
    from rich.console import Console, Group
    from rich.live import Live
    from rich.progress import Progress
    from rich.text import Text

    console = Console(stderr=True)
    bar = Progress(console=console, auto_refresh=False)
    line = bar.add_task("training", total=None)
    values: list[float] = []
    with Live(bar, console=console, refresh_per_second=4) as live:

        def show(words: str, value: float, done: int, steps: int, _due: bool) -> None:
            values.append(value)
            bar.update(line, completed=done, total=steps, description="training")
            live.update(Group(bar, Text(words), Text(f"{quantity} {curve(values)}")))

        yield show
