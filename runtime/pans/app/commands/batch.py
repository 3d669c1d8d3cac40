"""`pans batch`: one command over many recordings, bundles or seeds, here, in several processes, or on the workers of a Dask scheduler.

Each finished item is one line of a journal, synced, so that a batch that was ended at any time continues where it was. An item whose worker
dies is done by another one. Dask's own messages are pickled: connect only to a scheduler that you trust, in a network that you trust.
"""

from __future__ import annotations

import argparse
import ctypes
import glob
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from pans.app.command import Command, add_force, parser_of
from pans.app.find_commands import find_commands, load_command
from pans.base.console import emit, needed, progress_bar, say
from pans.base.errors import EXIT_ALERT, EXIT_FINE, EXIT_INTERRUPTED, LinkError, UsageError, refusing
from pans.base.files import check_outputs
from pans.base.numbers import Range
from pans.record.tables import need_pyarrow, write_rows

FORMAT = "pans-batch 1"
ON_FILES = ("replay", "evaluate", "refit", "report", "verify", "info", "export")
ON_NAMES = ("reproduce", "train", "baseline")
WORKERS = Range(1, 1024, whole=True)
ITEMS_MAX, VALUES_MAX = 1_000_000, 100_000
STDERR_CHARACTERS = 2000
RETRIES, CONNECT_S, OF_DASK = 2, 30, ("--dask", "dask")
REPORT_EVERY_S = 5.0
_DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)


@dataclass(frozen=True, slots=True)
class Item:
    """One run of the command: its words, what is varied, and a key that changes when the words or the input file change."""

    path: str
    words: tuple[str, ...]
    varied: tuple[tuple[str, str], ...]
    key: str


def items_of(command: str, inputs: Sequence[str], vary: Sequence[str], extra: str, *, files: bool) -> list[Item]:
    """Return the items: each input with each combination of the varied options; UsageError for a pattern that nothing matches.

    `vary` holds `NAME=VALUES`, `extra` further words, in which `{path}`, `{folder}`, `{stem}` and the varied names are replaced.
    """
    options = dict(_values(one) for one in vary)
    paths = [path for one in inputs for path in (_matching(one) if files else [one])]
    try:
        words = shlex.split(extra)
    except ValueError as error:
        raise UsageError(f"--with {extra!r}: {error}", remedy="close its quotes") from error
    items = [
        _item(command, path, dict(zip(options, chosen)), words)
        for path in dict.fromkeys(paths)
        for chosen in product(*options.values())
    ]
    if len(items) > ITEMS_MAX:
        raise UsageError(f"{len(items)} items, allowed at most {ITEMS_MAX}", remedy="vary fewer options at once")
    return items


def _matching(pattern: str) -> list[str]:
    found = sorted(glob.glob(pattern, recursive=True)) if glob.has_magic(pattern) else [pattern]
    if not found or not all(map(os.path.exists, found)):
        raise UsageError(f"{pattern}: there is no such file", remedy="put patterns in quotes: 'runs/*/run.pansrec'")
    return found


def _values(text: str) -> tuple[str, list[str]]:
    """Read `NAME=1,2,5` or `NAME=0-9`."""
    name, _, values = text.removeprefix("--").partition("=")
    found = [value for value in values.split(",") if value]
    ends = re.fullmatch(r"(\d{1,9})-(\d{1,9})", values)
    if ends and int(ends[1]) <= int(ends[2]):
        numbers = range(int(ends[1]), int(ends[2]) + 1)
        if len(numbers) > VALUES_MAX:
            raise UsageError(f"--vary {text}: more than {VALUES_MAX} values", remedy="vary fewer")
        found = [str(number) for number in numbers]
    if not name or not found:
        raise UsageError(f"--vary {text!r} is not NAME=VALUES", remedy="write seed=0-9, or eta=0.5,1,2")
    return name, found


def _item(command: str, path: str, chosen: Mapping[str, str], extra: Sequence[str]) -> Item:
    words = [command, path]
    for name, value in chosen.items():
        if not any(f"{{{name}}}" in word for word in extra):
            words += [f"--{name}", value]
    places = {"path": path, "folder": os.path.dirname(path) or ".", "stem": Path(path).stem, **chosen}
    for word in extra:
        for name, value in places.items():
            word = word.replace(f"{{{name}}}", value)
        words.append(word)
    try:
        found = os.stat(path)
        identity = [found.st_size, found.st_mtime_ns]  # one that has changed is done again
    except OSError:  # no file, but a name
        identity = []
    return Item(path, tuple(words), tuple(chosen.items()), json.dumps([words, identity]))


# ---- one item, in a worker ----


def run_item(words: Sequence[str], folder: str, patience_s: float | None = None) -> dict[str, Any]:
    """Run `pans WORDS --json` in `folder`, in a process of its own, and return exit code, seconds, host, and the answer or the error."""
    began_s = time.monotonic()
    command = [sys.executable, "-m", "pans", *words, "--json"]
    row: dict[str, Any] = {"exit": None, "seconds": 0.0, "host": socket.gethostname(), "answer": None, "error": None}
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "capture_output": True, "text": True}
    try:
        done = subprocess.run(command, cwd=folder, timeout=patience_s, preexec_fn=_end_with_parent(), **pipes)
    except (OSError, subprocess.TimeoutExpired) as error:
        return row | {"error": f"cannot be run in {folder}: {error}"}
    answer = _answer(done.stdout)
    fault = answer.get("error") if isinstance(answer, dict) else None
    if isinstance(fault, dict):
        row["error"], answer = str(fault.get("message")), None
    elif answer is None:
        row["error"] = done.stderr[-STDERR_CHARACTERS:].strip() or "no answer"
    return row | {"exit": done.returncode, "seconds": round(time.monotonic() - began_s, 3), "answer": answer}


def _answer(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _end_with_parent() -> Any:
    """Let the command end when its worker is killed: another worker does the item again, and two must not write one file."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl
    return lambda: prctl(_DIES_WITH_PARENT, signal.SIGKILL)


@contextmanager
def workers(number: int, dask: str) -> Iterator[Executor]:
    """Yield what runs `number` items at a time here, or as many as the scheduler at the address `dask` can; LinkError without one."""
    if not dask:
        pool = ThreadPoolExecutor(number)
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)
        return
    try:
        client = needed("distributed", *OF_DASK).Client(dask, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        what = f"--dask {dask}: no scheduler answers: {error}"
        raise LinkError(what, remedy="start one with `dask scheduler`, or use --workers") from error
    with client:
        pool = client.get_executor(pure=False, retries=RETRIES)
        try:
            yield pool
        finally:
            pool.shutdown(wait=False)


# ---- the journal ----


class Journal:
    """The results so far, one JSON object per line of the file `path`; `rows` by the keys of their items."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[str, dict[str, Any]] = {}

    def read(self) -> None:
        """Read what is there; a last line that was cut goes. UsageError for a file that is no journal."""
        whole = 0
        with open(self.path, "rb") as file:
            for line in file:
                row = _answer(line.decode("utf-8", "replace")) if line.endswith(b"\n") else None
                if not isinstance(row, dict) or row.get("format") != FORMAT or not isinstance(row.get("key"), str):
                    break
                self.rows[row["key"]] = row
                whole += len(line)
            rest, size = file.read(1), os.fstat(file.fileno()).st_size
        if rest or (size and not whole):
            raise UsageError(f"{self.path}: is not the journal of a batch", remedy="choose another name with --out")
        os.truncate(self.path, whole)

    def add(self, item: Item, row: Mapping[str, Any]) -> None:
        """Write one result, synced."""
        self.rows[item.key] = {"format": FORMAT, "key": item.key, "item": item.path, **dict(item.varied), **row}
        refused = refusing(f"{self.path}: cannot be written", "make room, then continue with --resume")
        with refused, open(self.path, "ab") as file:
            file.write((json.dumps(self.rows[item.key]) + "\n").encode())
            file.flush()
            os.fsync(file.fileno())


def flat_rows(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows for a table: the answer's keys among the others, one level of objects with a dot in between."""
    flat = []
    for row in rows:
        found = {key: value for key, value in row.items() if key not in ("format", "key", "answer")}
        for key, value in (row.get("answer") or {}).items():
            if isinstance(value, dict):
                found |= {f"{key}.{inner}": one for inner, one in value.items()}
            else:
                found[key if key not in found else f"answer.{key}"] = value
        flat.append(found)
    return flat


# ---- the command ----


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("command", metavar="COMMAND", choices=(*ON_FILES, *ON_NAMES), help="what to do with each input")
    add("inputs", nargs="+", metavar="INPUT", help="files or patterns in quotes; of reproduce, train: names")
    add("-o", "--out", type=Path, required=True, metavar="OUT", help="results: .parquet or .jsonl")
    values = "run each input with each of these values of --NAME: seed=0-9, or eta=0.5,1,2 (repeatable)"
    add("--vary", action="append", default=[], metavar="NAME=VALUES", help=values)
    further = "further options of COMMAND; {path}, {folder}, {stem} and varied names are replaced"
    add("--with", dest="extra", default="", metavar="WORDS", help=further)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=WORKERS.option, metavar="N", help="N at a time on this machine")
    scheduler = "a scheduler of Dask, such as tcp://host:8786 (extra dask)"
    where.add_argument("--dask", default="", metavar="URL", help=scheduler)
    resume = "continue these results: only what is missing or has changed"
    add("--resume", action="store_true", help=resume)
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    journal = _journal(args)
    items = items_of(args.command, args.inputs, args.vary, args.extra, files=args.command in ON_FILES)
    _check_words(args.command, items[0])
    if args.resume and journal.path.exists():
        journal.read()
    elif args.force:
        journal.path.unlink(missing_ok=True)
    # what failed without an answer is tried again
    todo = [item for item in items if journal.rows.get(item.key, {}).get("answer") is None]
    if len(todo) < len(items):
        say(f"{len(items) - len(todo)} of {len(items)} are done already")
    began_s = time.monotonic()
    try:
        if todo:
            _work(args, journal, todo)
    except KeyboardInterrupt:
        say(f"interrupted; finished results are in {journal.path}\n  continue: the same command with --resume")
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
    lines = [f"{len(items)} items, {len(failed)} of them not with exit code 0: {args.out}"]
    lines += [f"  {row['item']}: exit {row['exit']}: {row['error'] or 'an alert'}" for row in failed[:20]]
    emit(args, payload, "\n".join(lines))
    return EXIT_ALERT if failed else EXIT_FINE


def _journal(args: argparse.Namespace) -> Journal:
    """Check the outputs and return the journal: OUT itself, or one next to a Parquet file."""
    if args.out.suffix not in (".parquet", ".jsonl"):
        raise UsageError(f"--out {args.out}: allowed are .parquet and .jsonl", remedy="name it results.jsonl")
    if args.out.suffix == ".parquet":
        need_pyarrow()
    if args.dask:
        needed("distributed", *OF_DASK)
    path = args.out if args.out.suffix == ".jsonl" else args.out.with_name(f"{args.out.name}.jsonl")
    if not args.resume and path.exists() and not args.force:
        raise UsageError(
            f"{path}: exists already", remedy="continue with --resume, choose another name, or use --force"
        )
    mine = args.resume and path.exists()
    check_outputs({args.out, path}, force=args.force, ours=lambda found: mine)
    return Journal(path)


def _check_words(command: str, item: Item) -> None:
    """A wrong option is found before anything runs."""
    commands = find_commands()
    if command not in commands:
        raise UsageError(f"there is no `pans {command}` here", remedy="`pans` lists the commands")
    parser_of(command, load_command(commands[command])).parse_args([*item.words[1:], "--json"])


def _work(args: argparse.Namespace, journal: Journal, todo: list[Item]) -> None:
    folder, began_s = str(Path.cwd()), time.monotonic()
    reported_s = began_s
    with workers(args.workers or 1, args.dask) as pool, progress_bar("batch", len(todo)) as report:
        items = {pool.submit(run_item, item.words, folder): item for item in todo}
        for number, future in enumerate(as_completed(items), 1):
            try:
                row = future.result()
            except Exception as error:  # a worker of Dask that died again and again, or that has no pans
                row = {"exit": None, "seconds": None, "host": "", "answer": None}
                row["error"] = f"{type(error).__name__}: {error}"[:2000]
            journal.add(items.pop(future), row)
            report(number)
            now_s = time.monotonic()
            if not sys.stderr.isatty() and now_s - reported_s > REPORT_EVERY_S and number < len(todo):
                reported_s = now_s
                left_s = (now_s - began_s) / number * (len(todo) - number)
                say(f"{number} of {len(todo)} done, about {left_s:.0f} s left")


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
