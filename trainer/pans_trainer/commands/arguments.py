"""What several of the trainer's commands share: common options, the check for torch, errors of the user's input, and progress on stderr."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from math import floor
from typing import TYPE_CHECKING, Any

from pans.base.console import missing_extra, say, warn, work_bar
from pans.base.files import SIDE_PX, Reading
from pans.base.numbers import Range
from pans.instrument.profile import Profile

if TYPE_CHECKING:
    from pans.bundle.sensor import Bundle

CURVE_WIDTH = 48
HISTORY_FILES = ("history.json", "curves.png", "evolution.png")
_BLOCKS = "▁▂▃▄▅▆▇█"

Show = Callable[[str, float, int, int, bool], None]  # words, value of the curve, done, of how many, whether to print


def add_data_dir(parser: argparse.ArgumentParser) -> None:
    """Add --data-dir to a command that may need a public set."""
    parser.add_argument("--data-dir", metavar="DIR", help="folder of the public sets (default: $PANS_DATA)")


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how the photos of a folder become images of one size."""
    group = parser.add_argument_group("of a folder of photos")
    words = f"longer side of the images in pixels (default {SIDE_PX}; small pictures of one size stay as they are)"
    group.add_argument("--resize", type=Range(4, 1024, whole=True).option, metavar="N", help=words)
    words = "where aspect ratios differ: cut what lies beyond the mean one (default), or pad with black"
    group.add_argument("--fit", choices=("crop", "pad"), default="crop", help=words)
    group.add_argument("--skip-bad", action="store_true", help="pass over files that cannot be taken, and say why")


def reading_from(args: argparse.Namespace) -> Reading:
    """Return what the options of `add_reading` ask for."""
    return Reading(args.resize, args.fit == "pad", args.skip_bad)


def add_threads(parser: argparse.ArgumentParser, consequence: str = "; changes the rounding") -> None:
    """Add --threads, the number of threads of torch."""
    kind = Range(1, 1024, whole=True).option
    parser.add_argument("--threads", type=kind, default=1, metavar="T", help=f"of torch (default 1){consequence}")


def interruptible(run: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """Return the work of a command, which SIGTERM and SIGHUP interrupt as Ctrl-C does: what is finished is kept, exit code 130."""

    @functools.wraps(run)
    def guarded(args: argparse.Namespace) -> int:
        from pans.live.stop import stop_signals

        with stop_signals(continuous=False):
            return run(args)

    return guarded


def warn_of_laws(bundle: Bundle, profile: Profile, *, eta: float = 1.0, one_by_one: bool = False) -> None:
    """Warn where the laws of the detector do not hold as stated, for the light of `bundle` on `profile`."""
    from pans.decide.plan import detector_warnings
    from pans_trainer.evaluate.accuracy import exposure_of

    for text in detector_warnings(profile, bundle, exposure_of(bundle, profile), eta=eta, one_by_one=one_by_one):
        warn(text)


def torch_with(threads: int, what: str = "training") -> Any:
    """Return torch, set to that many threads; UsageError where it is not installed."""
    with needing(what, "train"):
        import torch

        import pans_trainer.device  # noqa: F401  # it sets what torch needs on this processor
    torch.set_num_threads(threads)
    return torch


@contextmanager
def needing(option: str, extra: str) -> Iterator[None]:
    """Turn a missing package into a UsageError that names the `option` which needs it, and the `extra` that holds it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise missing_extra(option, str(error.name), extra) from error


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
def displayed_progress(quantity: str) -> Iterator[Show]:
    """Yield a function for every report; on a terminal a bar with remaining time and the curve of `quantity`, else lines."""
    if not sys.stderr.isatty():
        yield lambda words, _value, _done, _steps, due: say(words) if due else None
        return
    from rich.console import Console, Group
    from rich.live import Live
    from rich.progress import Progress
    from rich.text import Text

    console = Console(stderr=True)
    bar = Progress(console=console, auto_refresh=False)
    line = bar.add_task("done", total=None)
    values: list[float] = []
    with Live(bar, console=console, refresh_per_second=4) as live:

        def show(words: str, value: float, done: int, steps: int, _due: bool) -> None:
            values.append(value)
            bar.update(line, completed=done, total=steps, description="done")
            live.update(Group(bar, Text(words), Text(f"{quantity} {curve(values)}")))

        yield show


@contextmanager
def displayed_parts() -> Iterator[Callable[[str, float], None]]:
    """Yield a `Report` of pieces of work: a bar on a terminal, else a line per quarter of each piece; both on stderr."""
    last = 0
    with work_bar() as bar:

        def report(what: str, done: float) -> None:
            nonlocal last
            quarter = floor(4 * done)
            if quarter > last and not (what.startswith("posterior") or sys.stderr.isatty()):
                say(f"  {25 * quarter} %  {what}")
            last = quarter
            bar(what, done)

        yield report
