"""`pans reproduce NAME`: the paper's tables and figures, ours beside the paper's, and the frontier, as Markdown, JSON and PNG.

Owns the arguments and what is refused; the pages are those of the packages `paper` and `frontier`. Every figure is SIMULATED.
Finished rows lie in a cache folder: a killed run goes on, and several processes may share the rows of a table (`--rows`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, Command, add_force, emit, say
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs, make_folder
from pans.trainer.claims.known import PAGES, page_of
from pans.trainer.paper import Asked, Made, Page, rewrite_page, write_page
from pans.trainer.paper.page import Rows, is_page_file, page_files, read_rows
from pans.trainer.paper.tables import ACTIVE, PASSIVE, UNPRINTED, table_of

from .arguments import interruptible, torch_with

CACHE = Path("~/.cache/pans-runtime/reproduce")
SEEDS_MAX = 100


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=(*PAGES, "all", "list", "check"), help="which table or figure")
    parser.add_argument("--rows", type=int, nargs="+", metavar="D", help="only the rows with that many patterns")
    parser.add_argument("--dark", type=float, nargs="+", metavar="R", help="only these dark counts (not of all tables)")
    parser.add_argument(
        "--data-seed",
        type=int,
        default=0,
        metavar="N",
        help="another draw of a drawn task (default 0); the page of draw 0 names the finished cells of others beside its own",
    )
    words = "of frontier, and of FashionMNIST and MNIST in equal-photons: how many seeds per row (default 5); finished ones are kept"
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help=words)
    parser.add_argument("--cache", type=Path, default=CACHE, metavar="DIR", help=f"finished rows (default: {CACHE})")
    words = "write NAME.json, the pictures and the tables of NAME.md there; what NAME.md says around the tables stays"
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help=words)
    words = "measure nothing: write the tables of NAME.md in the folder of -o again from NAME.json"
    parser.add_argument("--from-json", action="store_true", help=words)
    parser.add_argument("--collect", action="store_true", help="train nothing: put finished rows together")
    add_force(parser)
    parser.add_argument("--threads", type=int, default=1, metavar="T", help="of torch (default 1)")
    parser.add_argument("--data-dir", metavar="DIR", help="folder of the public sets (default: $PANS_DATA)")


def _run(args: argparse.Namespace) -> int:
    if args.data_seed < 0:
        raise UsageError(f"--data-seed is {args.data_seed}, allowed: 0 or more")
    if args.name == "list":
        emit(args, {"rows": list(PAGES)}, "\n".join(PAGES))
        return EXIT_FINE
    torch_with(args.threads)
    if args.name == "check":
        from .reproduce_check import check  # of torch, as the pages are

        return check(args)
    names = tuple(PAGES) if args.name == "all" else (args.name,)
    if args.out is not None:
        files = [path for name in names for path in page_files(args.out, name, page_of(name))]
        check_outputs(files, force=args.force, ours=is_page_file, makes_folders=True)
    if args.from_json:
        return _rewrite(names, args)
    for name in names:
        _check(name, args)
    args.cache = args.cache.expanduser()
    make_folder(args.cache)
    results: dict[str, tuple[Page, Made]] = {}
    try:
        for name in names:
            results[name] = _measured(name, args)
            if args.out:
                write_page(args.out, name, *results[name])
                _count_again(args.out)
    except KeyboardInterrupt:
        say(f"interrupted; finished rows and the row in work are in {args.cache}\n  go on: the same command")
        return EXIT_INTERRUPTED
    rows = [row for _, made in results.values() for row in made.rows]
    blocks = [page.around(page.block(name, made.rows, made.pictures)) for name, (page, made) in results.items()]
    emit(args, {"rows": rows, "simulated": True}, "\n\n".join(blocks))
    return EXIT_FINE


def _count_again(folder: Path) -> None:
    from pans.trainer.claims.index import rewrite_index  # of torch, which `list` does without

    rewrite_index(folder)


def _rewrite(names: tuple[str, ...], args: argparse.Namespace) -> int:
    if args.out is None:
        raise UsageError("--from-json reads and writes a folder", remedy="name it by -o DIR")
    rows: Rows = []
    for name in names:
        path = args.out / f"{name}.json"
        if not path.is_file():
            raise UsageError(f"{path} is not there", remedy=f"measure it: pans reproduce {name} -o {args.out}")
        rewrite_page(args.out, name, page_of(name))
        rows += read_rows(args.out, name)
    _count_again(args.out)
    emit(args, {"rows": rows, "simulated": True}, "\n".join(f"{args.out / name}.md" for name in names))
    return EXIT_FINE


def _measured(name: str, args: argparse.Namespace) -> tuple[Page, Made]:
    rows, dark = (None if wanted is None else tuple(wanted) for wanted in (args.rows, args.dark))
    asked = Asked(name, args.cache, rows, args.data_dir, args.collect, say, dark, args.data_seed, args.seeds, args.out)
    page = page_of(name)
    return page, page.measure(asked)


def _check(name: str, args: argparse.Namespace) -> None:
    """Refuse rows, dark counts, draws and seeds that a table does not have."""
    if not 1 <= args.seeds <= SEEDS_MAX:
        raise UsageError(f"--seeds is {args.seeds}, allowed: 1 to {SEEDS_MAX}")
    if name in ACTIVE:
        known = [row.features for row in ACTIVE[name]]
        if args.rows is not None and not {*known} & {*args.rows}:
            raise UsageError(f"--rows {args.rows}", remedy=f"{name} has {', '.join(map(str, known))}")
    if name not in PASSIVE and name not in UNPRINTED:
        if args.dark is not None and args.name != "all":
            raise UsageError(f"--dark has no effect on {name}", remedy="leave it out")
        return
    from pans.trainer.paper.passive_recipes import TASKS
    from pans.trainer.tasks.generators import GENERATORS

    drawn = TASKS.get(name, name) in GENERATORS and name != "barcode"  # all its strings are judged
    if args.data_seed and (args.out or not drawn):
        remedy = (
            "leave out -o; the page is of draw 0 and names others" if drawn else f"{name} is not drawn: leave it out"
        )
        raise UsageError(f"--data-seed {args.data_seed}", remedy=remedy)
    table = table_of(name)
    known = [row.features for row in table.rows]
    wanted = args.rows is None or {*known} & {*args.rows}
    levels = args.dark is None or {*table.dark} & {*args.dark}
    if not (wanted and levels):
        has = f"rows {', '.join(map(str, known))}, dark {', '.join(map(str, table.dark))}"
        raise UsageError(f"--rows {args.rows} --dark {args.dark}", remedy=f"{name} has {has}")


REPRODUCE = Command(
    "the paper's tables and figures, ours beside the paper's",
    _configure,
    interruptible(_run),
    examples=(
        "pans reproduce list",
        "pans reproduce fashion-mnist -o out",
        "pans reproduce check",
    ),
)
