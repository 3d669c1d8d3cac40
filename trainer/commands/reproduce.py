"""`pans reproduce NAME`: the paper's tables and figures, ours beside the paper's, as Markdown, JSON and PNG.

Owns the arguments, the walk over the rows and the files; what a row is, is in the reproduce_*.py modules. Every figure is SIMULATED.
Finished rows lie in a cache folder: a killed run goes on, and several processes may share the rows of a table (`--rows`).
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, Command, emit, say
from pans.runtime.errors import UsageError
from pans.trainer.paper.page import Asked, Draw, write_page
from pans.trainer.paper_tables import ACTIVE, PASSIVE, UNPRINTED

CACHE = Path("~/.cache/pans-runtime/reproduce")
NEEDS_TORCH = "pip install 'pans-runtime[train]'"


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=(*NAMES, "all", "list"), help="which table or figure")
    parser.add_argument("--rows", type=int, nargs="+", metavar="D", help="only the rows with that many patterns")
    parser.add_argument("--dark", type=float, nargs="+", metavar="R", help="only these dark counts (not of all tables)")
    parser.add_argument(
        "--data-seed",
        type=int,
        default=0,
        metavar="N",
        help="another draw of a drawn task (default 0); the page of draw 0 names the finished cells of others beside its own",
    )
    parser.add_argument("--cache", type=Path, default=CACHE, metavar="DIR", help=f"finished rows (default: {CACHE})")
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help="write NAME.md, NAME.json and the pictures there")
    parser.add_argument("--collect", action="store_true", help="train nothing: put finished rows together")
    parser.add_argument("--threads", type=int, default=1, metavar="T", help="of torch (default 1)")
    parser.add_argument("--data-dir", metavar="DIR", help="folder of the public sets (default: $PANS_DATA)")


def _run(args: argparse.Namespace) -> int:
    if args.name == "list":
        emit(args, {"rows": list(NAMES)}, "\n".join(NAMES))
        return EXIT_FINE
    try:
        import torch
    except ModuleNotFoundError as error:
        raise UsageError("training needs the package torch, which is not installed", remedy=NEEDS_TORCH) from error
    torch.set_num_threads(args.threads)
    args.cache = args.cache.expanduser()
    args.cache.mkdir(parents=True, exist_ok=True)
    results = {}
    try:
        for name in NAMES if args.name == "all" else (args.name,):
            results[name] = NAMES[name](name, args)
            if args.out:
                write_page(args.out, name, results[name])
    except KeyboardInterrupt:
        say(f"interrupted; finished rows and the row in work are in {args.cache}\n  go on: the same command")
        return EXIT_INTERRUPTED
    rows = [row for result in results.values() for row in result["rows"]]
    emit(args, {"rows": rows, "simulated": True}, "\n\n".join(result["markdown"] for result in results.values()))
    return EXIT_FINE


def _active(name: str, args: argparse.Namespace) -> dict[str, Any]:
    from pans.trainer.figures import accuracy_against_photons
    from pans.trainer.paper import active
    from pans.trainer.paper.active_table import markdown

    wanted = [row for row in active.rows_of(name) if args.rows is None or row.features in args.rows]
    if not wanted:
        raise UsageError(
            f"--rows {args.rows}", remedy=f"{name} has {', '.join(str(row.features) for row in active.rows_of(name))}"
        )
    done = []
    for row in wanted:
        figures = active.row_with_seeds(args.cache, name, row, args.data_dir, say, collect=args.collect)
        if figures is None:
            say(f"{name} d_f={row.features}: not trained yet")
            continue
        done.append((row, figures))
        ahead, clicks_fine = active.passed(row, figures)
        say(f"{name} d_f={row.features}: {ahead:+.2f} points, clicks {'fine' if clicks_fine else 'above +5 %'}")
    text = markdown(name, done)
    rows = [{"task": name, "paper": _facts(row), **figures} for row, figures in done]
    pictures = {"": partial(accuracy_against_photons, name=name, done=done)}
    return {"rows": rows, "markdown": text, "pictures": pictures}


def _facts(row: Any) -> dict[str, Any]:
    return {key: getattr(row, key) for key in row.__dataclass_fields__}


def _passive(name: str, args: argparse.Namespace) -> dict[str, Any]:
    from pans.trainer.figures import measure_over_patterns
    from pans.trainer.paper import passive
    from pans.trainer.paper.passive_recipes import TASKS
    from pans.trainer.paper.passive_table import markdown, table_of
    from pans.trainer.paper.picture_samples import draw_samples
    from pans.trainer.tasks.generators import GENERATORS

    drawn = TASKS.get(name, name) in GENERATORS and name != "barcode"  # all its strings are judged
    if args.data_seed and (args.out or not drawn):
        remedy = (
            "leave out -o; the page is of draw 0 and names others" if drawn else f"{name} is not drawn: leave it out"
        )
        raise UsageError(f"--data-seed {args.data_seed}", remedy=remedy)
    table = table_of(name)
    wanted = [row for row in table.rows if args.rows is None or row.features in args.rows]
    levels = [dark for dark in table.dark if args.dark is None or dark in args.dark]
    if not (wanted and levels):
        known = f"rows {', '.join(str(row.features) for row in table.rows)}, dark {', '.join(map(str, table.dark))}"
        raise UsageError(f"--rows {args.rows} --dark {args.dark}", remedy=f"{name} has {known}")
    done, others = [], []
    for row in wanted:
        for dark in levels:
            figures = passive.finished_cell(args.cache, name, row, dark, args.data_seed)
            if figures is None and not args.collect:
                figures = passive.make_cell(args.cache, name, row, dark, args.data_dir, say, args.data_seed)
            if figures is not None:
                done.append((row, figures))
            if not args.data_seed:
                others += [(row, other) for other in passive.other_draws(args.cache, name, row, dark)]
    text = markdown(name, done, others)
    pictures: dict[str, Draw] = {"": partial(measure_over_patterns, name=name, done=done)}
    if samples := passive.samples_of(args.cache, name, done):
        pictures["-pictures"] = partial(draw_samples, name=name, cells=samples)
    return {"rows": [figures for _, figures in done + others], "markdown": text, "pictures": pictures}


def _page(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Measure a page of `PAGES`."""
    module, _, function = PAGES[name].partition(":")
    measure = getattr(importlib.import_module(f"pans.trainer.paper.{module}"), function)
    rows = None if args.rows is None else tuple(args.rows)
    page: dict[str, Any] = measure(Asked(name, args.cache, rows, args.data_dir, args.collect, say))
    return page


PAGES = {  # name: module and function that measure it (imported when asked for)
    "estimators": "estimators:estimator_table",
    "time": "time:time_table",
    "equal-photons": "equal:equal_table",
    "sweeps": "sweeps:sweep_table",
    "fig-2c": "information:information_table",
    "confusion": "confusion:confusion_page",
    "dark-counts": "robust:dark_page",
    "eta": "robust:eta_page",
    "fig-3": "shots:fig_3_page",
    "multi-shot": "shots:multi_shot_page",
    "single-shot": "single:single_shot_page",
    "alpha": "alpha:alpha_page",
    "evolution": "alpha:evolution_page",
    "fig-2e": "paradigms:fig_2e_page",
    "end-to-end": "paradigms:end_to_end_page",
    "compressive": "sensing:compressive_page",
    "direct-frames": "frames:frames_page",
}

NAMES: dict[str, Callable[[str, argparse.Namespace], dict[str, Any]]] = {
    **dict.fromkeys(ACTIVE, _active),
    **dict.fromkeys([*PASSIVE, *UNPRINTED], _passive),
    **dict.fromkeys(PAGES, _page),
}

REPRODUCE = Command("the paper's tables and figures, ours beside the paper's", _configure, _run)
