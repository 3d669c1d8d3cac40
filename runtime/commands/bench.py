"""`pans bench`: decision speed and accuracy of this machine; each benchmark is found by entry point (`pans.benches`).

The exit code is 0 whatever the figures are: a benchmark measures, tests judge.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pans.runtime.cli import EXIT_FINE, Command, add_force, emit, say
from pans.runtime.cli.finding import missing_extra
from pans.runtime.errors import UsageError
from pans.runtime.offered import load_offered
from pans.runtime.outputs import check_outputs
from pans.runtime.ranges import Range

NAMES = ("decide", "link", "loop", "ingest", "turn")


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("what", choices=[*NAMES, "all"], help="what to measure")
    add("--bundle", type=Path, action="append", default=[], help="a bundle to decide with (decide: may be repeated)")
    inputs = "decide: .npz with counts (n, d_f), shots, labels; one per --bundle"
    add("--inputs", type=Path, action="append", default=[], help=inputs)
    seconds = "loop: length of each of its six runs (default 5)"
    add("--seconds", type=Range(0.01, 86_400).option, default=5.0, help=seconds)
    add("--load", action="store_true", help="loop: keep both cores busy with other processes")
    frames = "ingest: also run the whole way over this many frames"
    add("--frames", type=Range(0, 10**12, whole=True).option, default=0, help=frames)
    add("--quick", action="store_true", help="fewer and shorter runs")
    add("--plot", type=Path, help="write a plot of speed against error (plot extra)")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    from pans.runtime.bench.rows import BenchOptions, machine_facts, table_text, write_plot

    _check_used(args)
    options = BenchOptions(tuple(args.bundle), tuple(args.inputs), args.seconds, args.frames, args.load, args.quick)
    if args.plot is not None:
        if not _is_installed("matplotlib"):
            raise missing_extra("--plot", "matplotlib", "plot")
        check_outputs([args.plot], inputs=[*args.bundle, *args.inputs], force=args.force)
    before = machine_facts()
    rows: list[dict[str, Any]] = []
    for name in NAMES if args.what == "all" else (args.what,):
        bench = _find(name)
        if bench is None:
            say(f"pans bench {name}: not installed")
            continue
        say(f"pans bench {name} ...")
        rows += [{"bench": name, **row} for row in bench(options)]
    machine = before | {"load_1min_after": machine_facts()["load_1min"]}
    if args.plot is not None:
        write_plot(rows, args.plot, force=args.force)
    text = "\n".join(f"{key:<16} {value}" for key, value in machine.items())
    emit(args, {"machine": machine, "rows": rows}, f"{text}\n\n{table_text(rows)}")
    return EXIT_FINE


def _is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False


def _check_used(args: argparse.Namespace) -> None:
    """Refuse options that the chosen benchmark would not use."""
    uses = {"bundle": "decide", "inputs": "decide", "load": "loop", "frames": "ingest"}
    for option, of in uses.items():
        if getattr(args, option) and args.what not in (of, "all"):
            raise UsageError(f"--{option} has no effect on `pans bench {args.what}`", remedy=f"it belongs to {of}")
    if args.inputs and len(args.inputs) != len(args.bundle):
        raise UsageError(
            f"{len(args.inputs)} times --inputs and {len(args.bundle)} times --bundle",
            remedy="give one --inputs for each --bundle",
        )


def _find(name: str) -> Callable[[Any], list[dict[str, Any]]] | None:
    for point in entry_points(group="pans.benches", name=name):
        found: Callable[[Any], list[dict[str, Any]]] = load_offered(point)
        return found
    return None


BENCH = Command(
    "benchmark decision speed and accuracy",
    _configure,
    _run,
    examples=(
        "pans bench decide --quick",
        "pans bench loop --seconds 10 --load",
    ),
)
