"""`pans reproduce NAME`: the paper's tables and figures, ours beside the paper's, and the frontier, as Markdown, JSON and PNG.

Finished rows stay in a cache folder: a killed run resumes, and several processes may share the rows of a table (`--rows`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pans.app.command import Command, add_force
from pans.base.console import emit, say
from pans.base.errors import EXIT_FINE, EXIT_INTERRUPTED, UsageError
from pans.base.files import check_outputs, make_folder
from pans.base.numbers import Range
from pans_trainer.reproduce.page import NAMES, Asked, Made, is_page_file, page_of, read_rows, rewrite_page, write_page
from pans_trainer.reproduce.printed import ACTIVE, PASSIVE

from .arguments import add_data_dir, add_threads, interruptible, torch_with

CACHE = Path("~/.cache/pans-runtime/reproduce")
SEEDS = Range(1, 100, whole=True)


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=(*NAMES, "all", "list"), help="which table or figure")
    parser.add_argument("--rows", type=int, nargs="+", metavar="D", help="only the rows with that many patterns")
    parser.add_argument("--dark", type=float, nargs="+", metavar="R", help="only these dark counts (not of all tables)")
    words = "another draw of a task that is drawn (default 0); not with -o"
    parser.add_argument("--data-seed", type=int, default=0, metavar="N", help=words)
    words = "of the frontier: seeds per row (default 5)"
    parser.add_argument("--seeds", type=SEEDS.option, default=5, metavar="N", help=words)
    words = "of the frontier, and of direct imaging beside scenes: measure only these ways; all else stands as in NAME.json of -o"
    parser.add_argument("--ways", nargs="+", metavar="WAY", help=words)
    parser.add_argument("--cache", type=Path, default=CACHE, metavar="DIR", help=f"finished rows (default: {CACHE})")
    words = "write NAME.json, the pictures and the tables of the Markdown page there; its text around the tables stays"
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help=words)
    words = "measure nothing: write the tables in the folder of -o again from NAME.json"
    parser.add_argument("--from-json", action="store_true", help=words)
    parser.add_argument("--collect", action="store_true", help="train nothing: put finished rows together")
    add_force(parser)
    add_threads(parser, "")
    add_data_dir(parser)


def _run(args: argparse.Namespace) -> int:
    if args.name == "list":
        emit(args, {"rows": list(NAMES)}, "\n".join(NAMES))
        return EXIT_FINE
    pages = [page_of(name) for name in (NAMES if args.name == "all" else (args.name,))]
    if args.out is not None:
        files = list(dict.fromkeys(path for page in pages for path in page.files(args.out)))
        check_outputs(files, force=args.force, ours=is_page_file, makes_folders=True)
    if args.from_json:
        return _rewrite(args)
    _check(args)
    from pans_trainer.reproduce.makers import measure

    torch_with(args.threads)
    cache = args.cache.expanduser()
    make_folder(cache)
    rows, dark, ways = (None if wanted is None else tuple(wanted) for wanted in (args.rows, args.dark, args.ways))
    known = () if ways is None else tuple(read_rows(args.out, args.name))
    made: list[Made] = []
    try:
        for page in pages:
            asked = Asked(
                page.name, cache, rows, args.data_dir, args.collect, say, dark, args.data_seed, args.seeds, ways, known
            )
            made.append(measure(page, asked))
            if args.out is not None:
                write_page(args.out, page, made[-1])
    except KeyboardInterrupt:
        say(f"interrupted; finished rows and the row in work are in {cache}\n  to resume: the same command")
        return EXIT_INTERRUPTED
    text = "\n\n".join(page.block(one.rows, page.drawn(one).pictures) for page, one in zip(pages, made))
    emit(args, {"rows": [row for one in made for row in one.rows], "simulated": True}, text)
    return EXIT_FINE


def _rewrite(args: argparse.Namespace) -> int:
    if args.out is None:
        raise UsageError("--from-json reads and writes a folder", remedy="name it by -o DIR")
    names = NAMES if args.name == "all" else (args.name,)
    rows = [row for name in names for row in read_rows(args.out, name)]
    for name in names:
        rewrite_page(args.out, page_of(name))
    emit(args, {"rows": rows, "simulated": True}, "\n".join(f"{args.out / page_of(name).markdown}" for name in names))
    return EXIT_FINE


def _check(args: argparse.Namespace) -> None:
    """Refuse rows, dark counts and draws that a table does not have."""
    from pans_trainer.reproduce.printed import recipe_facts
    from pans_trainer.tasks.generators import GENERATORS

    name, table = args.name, PASSIVE.get(args.name)
    features = [row.features for row in ACTIVE.get(name, table.rows if table else ())]
    if features and args.rows is not None and not {*features} & {*args.rows}:
        raise UsageError(f"--rows {args.rows}", remedy=f"{name} has {', '.join(map(str, features))}")
    if args.dark is not None and name != "all" and (table is None or not {*table.dark} & {*args.dark}):
        has = f"{name} has {', '.join(map(str, table.dark))}" if table else "leave it out"
        raise UsageError(f"--dark {args.dark} has no effect on {name}", remedy=has)
    if args.ways is not None:
        from pans_trainer.reproduce.ways import ways_of

        if (name != "frontier" and name not in PASSIVE) or not ways_of(name) or args.out is None:
            what = "--ways is for the frontier and for scenes beside a camera, with -o"
            raise UsageError(what, remedy="pans reproduce frontier --ways ... -o DIR")
        if unknown := [way for way in args.ways if way not in ways_of(name)]:
            raise UsageError(f"--ways {unknown}", remedy=f"allowed: {', '.join(ways_of(name))}")
    drawn = table is not None and recipe_facts(name).get("task", name) in GENERATORS and name != "barcode"
    if args.data_seed < 0 or (args.data_seed and (args.out or not drawn)):
        remedy = "leave out -o: the page is of draw 0" if drawn else f"{name} is not drawn: leave it out"
        raise UsageError(f"--data-seed {args.data_seed}", remedy=remedy)


REPRODUCE = Command(
    "the paper's tables and figures, ours beside the paper's",
    _configure,
    interruptible(_run),
    examples=("pans reproduce list", "pans reproduce fashion-mnist -o out"),
)
