"""What several of the trainer's commands share: their common options, the check for torch, and errors of the user's input."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import warn
from pans.runtime.errors import UsageError
from pans.runtime.imaging import Tolerance
from pans.runtime.instrument.profile import Profile

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle


def add_data_dir(parser: argparse.ArgumentParser) -> None:
    """Add --data-dir to a command that may need a public set."""
    parser.add_argument("--data-dir", metavar="DIR", help="folder of the public sets (default: $PANS_DATA)")


def add_order_and_bleach(parser: argparse.ArgumentParser) -> None:
    """Add --order and --bleach, of fixed patterns."""
    parser.add_argument(
        "--order",
        choices=("information", "dose"),
        help="show the patterns in the order that tells most first, per pattern or per light that it sends",
    )
    parser.add_argument(
        "--bleach",
        metavar="D0[:mixed]",
        help="train for objects of many emitters per pixel that bleach: 1/e of a pixel's light is left after D0 photoelectrons of "
        "illumination",
    )


def add_threads(parser: argparse.ArgumentParser, consequence: str = "; changes the rounding") -> None:
    """Add --threads, the number of threads of torch."""
    parser.add_argument("--threads", type=int, default=1, metavar="T", help=f"of torch (default 1){consequence}")


def interruptible(run: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """Return the work of a command, which SIGTERM and SIGHUP interrupt as Ctrl-C does: what is finished is kept, exit code 130."""

    @functools.wraps(run)
    def guarded(args: argparse.Namespace) -> int:
        from pans.runtime.live.continuous import stop_signals

        with stop_signals(continuous=False):
            return run(args)

    return guarded


def warn_of_laws(bundle: Bundle, profile: Profile, *, eta: float = 1.0, one_by_one: bool = False) -> None:
    """Warn where the laws of the detector do not hold as stated, for the light of `bundle` on `profile`."""
    from pans.runtime.core.plan import detector_warnings
    from pans.trainer.evaluate.accuracy import exposure_of

    for text in detector_warnings(profile, bundle, exposure_of(bundle, profile), eta=eta, one_by_one=one_by_one):
        warn(text)


def torch_with(threads: int, what: str = "training") -> Any:
    """Return torch, set to that many threads; UsageError where it is not installed."""
    if not 1 <= threads <= 1024:
        raise UsageError(f"--threads is {threads}, allowed: 1 to 1024")
    try:
        import torch

        import pans.trainer.device  # noqa: F401  # it sets what torch needs on this processor
    except ModuleNotFoundError as error:
        raise UsageError(
            f"{what} needs the package torch, which is not installed", remedy="pip install 'pans-runtime[train]'"
        ) from error
    torch.set_num_threads(threads)
    return torch


def stated_tolerance(profile: Profile) -> str | None:
    """Return the tolerance that `profile` states for its optics, as `--optics` spells it; None where it states perfect ones."""
    if profile.optics is None:
        return None
    tolerance = profile.optics.tolerance()
    return None if tolerance == Tolerance() else tolerance.spelled()


@contextmanager
def usage_errors() -> Iterator[None]:
    """Turn a ValueError of the numeric code into a UsageError: what the user asked for cannot be computed."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


@contextmanager
def needing(option: str, extra: str) -> Iterator[None]:
    """Turn a missing package into a UsageError that names the `option` which needs it, and the `extra` that holds it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise UsageError(
            f"{option} needs the package {error.name}, which is not installed",
            remedy=f"pip install 'pans-runtime[{extra}]'",
        ) from error
