"""`pans report`: one self-contained HTML page of a recording or a bundle.

Owns the command; the page is pages/run.py's. The page loads nothing from elsewhere and runs nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pans.runtime.cli import EXIT_FINE, Command, add_force, emit
from pans.runtime.outputs import check_outputs, write_file


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", type=Path, metavar="FILE", help="a recording (.pansrec) or a bundle (.pans)")
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


REPORT = Command("one self-contained page of a recording or a bundle", _configure, _run)
