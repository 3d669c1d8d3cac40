"""`pans bench`: decision speed and accuracy of this machine; each benchmark is found by entry point (`pans.benches`).

The exit code is 0 whatever the figures are: a benchmark measures, tests judge. With --against it is 1 where the loop has become slower.
"""

from __future__ import annotations

import argparse
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from pans.app.command import Command, add_force
from pans.base.console import emit, load_offered, refuse_without, say, warn
from pans.base.errors import EXIT_ALERT, EXIT_FINE, UsageError
from pans.base.files import check_outputs
from pans.base.numbers import Range

NAMES = ("decide", "link", "loop", "ingest", "turn")
OF_ONE: dict[str, dict[str, Any]] = {
    "decide": {"bundle": [], "inputs": []},
    "loop": {"load": False, "against": None},
}  # options of one benchmark alone


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("what", choices=[*NAMES, "all"], help="what to measure")
    add("--bundle", type=Path, action="append", default=[], help="a bundle to decide with (decide: may be repeated)")
    inputs = "decide: .npz with counts (n, d_f), shots, labels; one per --bundle"
    add("--inputs", type=Path, action="append", default=[], help=inputs)
    seconds = "loop: length of each of its six runs (default 5)"
    add("--seconds", type=Range(0.01, 86_400).option, default=5.0, help=seconds)
    add("--load", action="store_true", help="loop: keep both cores busy with other processes")
    against = "loop: compare with what an earlier `pans bench loop --json` printed; exit 1 where the loop is slower now"
    add("--against", type=Path, metavar="FILE", help=against)
    add("--plot", type=Path, help="write a plot of speed against error (plot extra)")
    add_force(parser)
    add("--quick", action="store_true", help="fewer and shorter runs")


def _run(args: argparse.Namespace) -> int:
    from pans.app.bench.against import compared, read_rows
    from pans.app.bench.rows import BenchOptions, machine_facts, table_text, write_plot
    from pans.base.console import needed

    for name, options_of_it in OF_ONE.items():
        if args.what not in (name, "all"):
            refuse_without(args, name, options_of_it)
    if args.inputs and len(args.inputs) != len(args.bundle):
        what = f"{len(args.inputs)} times --inputs and {len(args.bundle)} times --bundle"
        raise UsageError(what, remedy="give one --inputs for each --bundle")
    options = BenchOptions(tuple(args.bundle), tuple(args.inputs), args.seconds, args.load, args.quick)
    if args.plot is not None:
        needed("matplotlib.pyplot", "--plot")
        check_outputs([args.plot], inputs=[*args.bundle, *args.inputs], force=args.force)
    earlier = None if args.against is None else read_rows(args.against)
    before, rows = machine_facts(), list[dict[str, Any]]()
    benches = {point.name: point for point in entry_points(group="pans.benches")}
    for name in NAMES if args.what == "all" else (args.what,):
        say(f"pans bench {name} ...")
        rows += [{"bench": name, **row} for row in load_offered(benches[name])(options)]
    if args.plot is not None:
        write_plot(rows, args.plot, force=args.force)
    losses: list[str] = []
    if earlier is not None:
        found, losses = compared(rows, earlier)
        rows += found
        for loss in losses:
            warn(f"pans: {loss}")
    machine = before | {"load_1min_after": machine_facts()["load_1min"]}
    text = "\n".join(f"{key:<16} {value}" for key, value in machine.items())
    emit(args, {"machine": machine, "rows": rows, "losses": losses}, f"{text}\n\n{table_text(rows)}")
    return EXIT_ALERT if losses else EXIT_FINE


BENCH = Command(
    "benchmark decision speed and accuracy",
    _configure,
    _run,
    examples=(
        "pans bench decide --quick",
        "pans bench loop --seconds 10 --load",
        "pans bench loop --against before.json",
    ),
)
