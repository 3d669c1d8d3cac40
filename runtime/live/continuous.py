"""Running for days from the command line: recordings in parts, a state file, metrics, and how a signal ends it.

Owns these options of `pans run` and what lives as long as the run does; each thing itself is in rotate.py, state_file.py, metrics.py and
stopping.py. `Attendants` are started before the loop asks for real-time privileges, so that none of their threads inherits them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from pans.runtime.errors import UsageError

if TYPE_CHECKING:  # the options must not load what a run needs
    from pans.runtime.record.parts_writer import AnyRecorder, PartLimits

    from .run import LiveRun

MIB = 1 << 20


@dataclass(frozen=True, slots=True)
class Continuous:
    """What was asked for: parts (None: one recording), a state file, an address for metrics."""

    limits: PartLimits | None = None
    state: Path | None = None
    metrics: str = ""


def add_continuous_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to `pans run`."""
    group = parser.add_argument_group("running for days")
    group.add_argument("--rotate-mb", type=float, default=0.0, metavar="N", help="record in parts of about N MiB")
    group.add_argument(
        "--keep-mb",
        type=float,
        default=0.0,
        metavar="N",
        help="delete the oldest parts above N MiB (default: keep all)",
    )
    group.add_argument("--state", type=Path, metavar="FILE", help="write the run's state there as JSON, each second")
    group.add_argument(
        "--metrics",
        default="",
        metavar="HOST:PORT",
        help="serve figures for Prometheus; a port alone: this machine only",
    )


def continuous_of(args: argparse.Namespace) -> Continuous:
    """Return what the options ask for; UsageError for what cannot be meant. Commands without the options ask for nothing."""
    rotate_mb, keep_mb = getattr(args, "rotate_mb", 0.0), getattr(args, "keep_mb", 0.0)
    if min(rotate_mb, keep_mb) < 0:
        raise UsageError("--rotate-mb and --keep-mb must not be negative")
    if keep_mb and not rotate_mb:
        raise UsageError("--keep-mb deletes parts, and there are none", remedy="say how large with --rotate-mb")
    if rotate_mb and getattr(args, "on_dark", "warn") != "warn":
        raise UsageError(
            f"--rotate-mb with --on-dark {args.on_dark}: what the guard has learnt is not in a part, which could not be replayed",
            remedy="record without parts, or use --on-dark warn",
        )
    from pans.runtime.record.parts_writer import PartLimits

    limits = PartLimits(max(1, round(rotate_mb * MIB)), round(keep_mb * MIB)) if rotate_mb else None
    return Continuous(limits, getattr(args, "state", None), getattr(args, "metrics", ""))


def open_recorder(path: Path, header: Mapping[str, Any], bundle: bytes, limits: PartLimits | None) -> AnyRecorder:
    """Begin the recording, in parts where they are asked for."""
    from pans.runtime.record.parts_writer import PartedRecorder
    from pans.runtime.record.recorder import Recorder

    if limits is None:
        return Recorder(path, header, bundle=bundle, overwrite=True)
    return PartedRecorder(path, header, limits, bundle=bundle, overwrite=True)


class Attendants:
    """State file and metrics of one run; enter before it, `prepared` when it is there."""

    def __init__(self, wanted: Continuous, recorder: AnyRecorder | None) -> None:
        self._wanted, self._recorder = wanted, recorder
        self._run: LiveRun | None = None
        self._started_s = time.monotonic()
        self._open = ExitStack()
        self.metrics_url = ""

    def __enter__(self) -> Self:
        from .metrics import MetricsServer
        from .state_file import StateFile

        with ExitStack() as opening:
            if self._wanted.metrics:
                server = MetricsServer(self._wanted.metrics, self.look)
                opening.callback(server.close)
                self.metrics_url = f"http://{server.host}:{server.port}/metrics"
            if self._wanted.state is not None:
                opening.callback(StateFile(self._wanted.state, self.look).close)
            self._open = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def prepared(self, run: LiveRun) -> None:
        """Show `run` from here on."""
        self._run = run

    def look(self) -> dict[str, Any]:
        """Return the picture as it is now."""
        from .state_file import picture_of

        return picture_of(self._run, self._recorder, self._started_s)
