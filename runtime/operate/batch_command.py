"""`pans batch`: one command over many recordings, bundles or seeds, in several processes or on several machines.

Owns the arguments, the progress and the files of results; items and journal are batch.py's, workers are workers.py's.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, EXIT_INTERRUPTED, Command, add_force, emit, say
from pans.runtime.cli.command import parser_of
from pans.runtime.cli.finding import find_commands, load_command
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs
from pans.runtime.ranges import Range

from .batch import Item, Journal, flat_rows, items_of
from .parquet import need_pyarrow, write_rows
from .workers import need_distributed, results_here, results_of_dask

ON_FILES = ("replay", "evaluate", "refit", "report", "verify", "info", "export")
ON_NAMES = ("reproduce", "train", "baseline")
WORKERS = Range(1, 1024, whole=True)
TELL_EVERY_S = 5.0


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("command", metavar="COMMAND", choices=(*ON_FILES, *ON_NAMES), help="what to do with each input")
    parser.add_argument(
        "inputs", nargs="+", metavar="INPUT", help="files or patterns in quotes; of reproduce, train: names"
    )
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="results: .parquet or .jsonl")
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=VALUES",
        help="run each input with each of these values of --NAME: seed=0-9, or eta=0.5,1,2 (repeatable)",
    )
    parser.add_argument(
        "--with",
        dest="extra",
        default="",
        metavar="WORDS",
        help="further options of COMMAND; {path}, {folder}, {stem} and varied names are replaced",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=WORKERS.option, metavar="N", help="N processes on this machine (extra dask)")
    where.add_argument(
        "--dask", default="", metavar="URL", help="a scheduler of Dask, such as tcp://host:8786 (extra dask)"
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on with these results: only what is missing or has changed"
    )
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    journal = _journal(args)
    items = items_of(args.command, args.inputs, args.vary, args.extra, files=args.command in ON_FILES)
    _check_words(args.command, items[0])
    if args.resume and journal.path.exists():
        journal.read()
    elif args.force:
        journal.path.unlink(missing_ok=True)
    todo = [item for item in items if not _is_done(journal, item)]
    if len(todo) < len(items):
        say(f"{len(items) - len(todo)} of {len(items)} are done already")
    began_s = time.monotonic()
    try:
        _work(args, journal, todo)
    except KeyboardInterrupt:
        say(f"interrupted; finished results are in {journal.path}\n  go on: the same command with --resume")
        return EXIT_INTERRUPTED
    rows = [journal.rows[item.key] for item in items]
    if args.out.suffix == ".parquet":
        write_rows(args.out, flat_rows(rows), force=args.force or args.resume)
    failed = [row for row in rows if row["exit"] != 0]
    payload = {
        "results": str(args.out),
        "items": len(items),
        "run": len(todo),
        "failed": [{"item": row["item"], "exit": row["exit"], "error": row["error"]} for row in failed],
        "seconds": round(time.monotonic() - began_s, 3),
    }
    words = [f"{len(items)} items, {len(failed)} of them not with exit code 0: {args.out}"]
    emit(
        args,
        payload,
        "\n".join(
            [*words, *(f"  {row['item']}: exit {row['exit']}: {row['error'] or 'an alert'}" for row in failed[:20])]
        ),
    )
    return EXIT_ALERT if failed else EXIT_FINE


def _journal(args: argparse.Namespace) -> Journal:
    """Check the outputs and return the journal: OUT itself, or beside a Parquet file."""
    if args.out.suffix not in (".parquet", ".jsonl"):
        raise UsageError(f"--out {args.out}: allowed are .parquet and .jsonl", remedy="name it results.jsonl")
    if args.out.suffix == ".parquet":
        need_pyarrow()
    if args.dask or args.workers:
        need_distributed()
    path = args.out if args.out.suffix == ".jsonl" else args.out.with_name(f"{args.out.name}.jsonl")
    if not args.resume and path.exists() and not args.force:
        raise UsageError(f"{path}: exists already", remedy="go on with --resume, choose another name, or use --force")
    mine = args.resume and path.exists()
    check_outputs({args.out, path}, force=args.force, ours=lambda found: mine)
    return Journal(path)


def _check_words(command: str, item: Item) -> None:
    """A wrong option is found before anything runs."""
    commands = find_commands()
    if command not in commands:
        raise UsageError(f"there is no `pans {command}` here", remedy="`pans` lists the commands")
    parser_of(command, load_command(commands[command])).parse_args([*item.words[1:], "--json"])


def _is_done(journal: Journal, item: Item) -> bool:
    """Whether the item has an answer; what failed without one is tried again."""
    row = journal.rows.get(item.key)
    return row is not None and row.get("answer") is not None


def _work(args: argparse.Namespace, journal: Journal, todo: list[Item]) -> None:
    folder = str(Path.cwd())
    if not todo:
        return
    if args.dask or args.workers:
        results = results_of_dask(todo, folder, address=args.dask, workers=args.workers or 0)
    else:
        results = results_here(todo, folder)
    with closing(_counted(results, len(todo))) as counted:  # type: ignore[type-var]
        for item, row in counted:
            journal.add(item, row)


def _counted(results: Iterator[tuple[Item, dict[str, Any]]], total: int) -> Iterator[tuple[Item, dict[str, Any]]]:
    """Yield the results and tell how far the batch is: a bar on a terminal, else a line now and then."""
    began_s = told_s = time.monotonic()
    with _bar(total) as step:
        for number, (item, row) in enumerate(results, 1):
            yield item, row
            step()
            now_s = time.monotonic()
            if not sys.stderr.isatty() and now_s - told_s > TELL_EVERY_S and number < total:
                told_s = now_s
                left_s = (now_s - began_s) / number * (total - number)
                say(f"{number} of {total} done, about {left_s:.0f} s left")


def _bar(total: int) -> Any:
    if not sys.stderr.isatty():
        return nullcontext(lambda: None)
    from contextlib import contextmanager

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    @contextmanager
    def shown() -> Iterator[Any]:
        columns = (TextColumn("batch"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("", total=total)
            yield lambda: progress.advance(task)

    return shown()


BATCH = Command(
    "run one command on many recordings, bundles or seeds, with Dask if wanted",
    _configure,
    _run,
    (
        "pans batch replay 'runs/*/run.pansrec' --workers 4 -o replays.parquet",
        "pans batch evaluate fashion10.pans --vary seed=0-9 --with='--trials 5' -o seeds.jsonl",
        "pans batch report 'runs/*/run.pansrec' --with='-o {folder}/report.html' --dask tcp://host:8786 -o reports.jsonl",
    ),
)
