"""`pans report` and `pans compare`: one self-contained HTML page of a recording or a bundle, and of two runs side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

from pans.runtime.cli import EXIT_FINE, Command, add_force, emit
from pans.runtime.outputs import check_outputs, write_file


def _configure(parser: argparse.ArgumentParser) -> None:
    what = "a recording (file, folder or index of its parts), or a bundle"
    parser.add_argument("path", type=Path, metavar="FILE", help=what)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT.html", help="the page to write")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    check_outputs([args.out], inputs=[args.path], force=args.force)
    from pans.runtime.pages import page_of
    from pans.runtime.report.verify import file_kind

    page = page_of(args.path)
    kind = file_kind(args.path)
    write_file(args.out, page, force=args.force)
    emit(args, {"report": str(args.out), "kind": kind, "bytes": len(page)}, str(args.out))
    return EXIT_FINE


REPORT = Command(
    "one self-contained page of a recording or a bundle",
    _configure,
    _run,
    examples=(
        "pans report pans-runs/latest/run.pansrec -o run.html",
        "pans report my.pans -o bundle.html",
    ),
)


def _configure_compare(parser: argparse.ArgumentParser) -> None:
    side = "a run's folder, a recording (.pansrec), or a summary as `pans run --json` prints it (.json)"
    for name, metavar in (("first", "A"), ("second", "B")):
        parser.add_argument(name, type=Path, metavar=metavar, help=side)
    parser.add_argument(
        "--objects",
        default="auto",
        choices=("auto", "same", "different"),
        help="whether objects of the same number are the same (default auto: of the same simulated scene)",
    )
    parser.add_argument("-o", "--out", type=Path, metavar="OUT.html", help="also write a page")
    add_force(parser)


def _compare(args: argparse.Namespace) -> int:
    if args.out is not None:
        check_outputs([args.out], inputs=[args.first, args.second], force=args.force)
    from pans.runtime.compare import compare, read_side
    from pans.runtime.compare.words import comparison_words

    found = compare(read_side(args.first), read_side(args.second), args.objects)
    if args.out is not None:
        from pans.runtime.compare.page import comparison_page

        write_file(args.out, comparison_page(found), force=args.force)
    report = {"report": None if args.out is None else str(args.out)}
    emit(args, found.as_json() | report, comparison_words(found))
    return EXIT_FINE


COMPARE = Command(
    "compare two runs: what changed, and is it significant",
    _configure_compare,
    _compare,
    examples=("pans compare pans-runs/2026-11-22T1412-fashion10 pans-runs/latest -o compared.html",),
)
