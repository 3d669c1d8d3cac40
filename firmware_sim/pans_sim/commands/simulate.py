"""`pans simulate`: a stand-alone simulated instrument behind a pseudo-terminal or TCP; the first line on stdout is its URL."""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import NoReturn

from pans.app.command import Command
from pans.base.console import add_options, emit, options_from, say
from pans.base.machine import check_core
from pans.base.numbers import Range
from pans_sim.ports.faults import check_possible, parse_faults
from pans_sim.ports.serve import SimOptions, build_instrument, check_options
from pans_sim.ports.shell import open_port, serve


def _configure(parser: argparse.ArgumentParser) -> None:
    add_options(parser, SimOptions)
    parser.add_argument("--listen", default="pty", help="pty (default) or tcp:127.0.0.1:PORT")
    parser.add_argument("--core", type=int, metavar="N", help="pin to core N and busy-wait; uses 100 %% of that core")
    parser.add_argument(
        "--any-core", action="store_true", help="do not leave the last core to the thread of a run that decides"
    )
    parser.add_argument(
        "--echo",
        type=Range(0, 1 << 20, whole=True).option,
        metavar="BYTES",
        help="no instrument: answer each frame with BYTES bytes (for benchmarks)",
    )
    parser.add_argument("--until-stdin-closes", action="store_true", help="end with the process that started this one")


def _run(args: argparse.Namespace) -> int:
    options = check_options(options_from(args, SimOptions))
    check_core(args.core)
    check_possible(parse_faults(args.faults), pace="real", listen=args.listen)
    instrument, clock = build_instrument(options, time.perf_counter_ns())
    if args.echo is not None:
        instrument = FrameEcho(args.echo)
    port = open_port(args.listen)
    signal.signal(signal.SIGTERM, leave)
    orphaned = _watch_stdin() if args.until_stdin_closes else threading.Event()
    try:
        _announce(args, port.url)
        gc.freeze()  # what was made so far is never collected: hardware has no pauses
        gc.enable()
        serve(instrument, clock, port, orphaned.is_set, args.core, args.realtime, not args.any_core)
    finally:
        port.close()
    return 0


def _announce(args: argparse.Namespace, url: str) -> None:
    payload = {"device": url, "profile": args.profile, "scene": args.scene, "seed": args.seed, "simulated": True}
    emit(args, payload, url)
    if not args.until_stdin_closes:
        say(f"SIMULATED instrument {args.profile} before scene {args.scene}; Ctrl-C ends it")


class FrameEcho:
    """No instrument at all: as many bytes back for every delimiter that comes, to know what the port alone costs."""

    session = 0

    def __init__(self, n_bytes: int) -> None:
        self._answer = bytes(n_bytes)

    def step(self, tick: int, data: bytes) -> bytes:
        """See `SteppedDevice`."""
        return self._answer * data.count(0)

    def next_event_tick(self) -> int | None:
        """See `SteppedDevice`."""
        return None

    def draw_ahead(self) -> bool:
        """See `SteppedDevice`."""
        return False


def _watch_stdin() -> threading.Event:
    """Return an event that is set when the starting process closes our standard input, by dying at the latest."""
    closed = threading.Event()

    def watch() -> None:
        try:
            while os.read(sys.stdin.fileno(), 4096):
                pass
        except OSError:
            pass
        closed.set()

    threading.Thread(target=watch, name="pans-sim-stdin", daemon=True).start()
    return closed


def leave(signum: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(0)


SIMULATE = Command(
    "run a simulated instrument that other programs open as an ordinary device",
    _configure,
    _run,
    examples=(
        "pans simulate --profile dmd-spad --scene fashion200 --listen pty",
        "pans simulate --profile oled-qcmos --listen tcp:127.0.0.1:0 --faults loss:0.01",
    ),
)
