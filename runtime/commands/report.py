"""`pans report`: one self-contained HTML page of a recording or a bundle (extra `plot`).

Owns the command; the page is page_run.py's. The page loads nothing from elsewhere and runs nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pans.runtime.bundle.model import load_bundle
from pans.runtime.cli import EXIT_FINE, Command, emit
from pans.runtime.container import replace_file
from pans.runtime.errors import UsageError
from pans.runtime.record import read_recording
from pans.runtime.report.verify import file_kind


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", type=Path, metavar="FILE", help="a recording (.pansrec) or a bundle (.pans)")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT.html", help="the page to write")


def _run(args: argparse.Namespace) -> int:
    from pans.runtime.report.page_run import bundle_page, recording_page

    kind = file_kind(args.path)
    if kind == "recording":
        page = recording_page(read_recording(args.path, salvage=True))
    elif kind == "bundle":
        bundle, sha256 = load_bundle(args.path)
        page = bundle_page(bundle, sha256, args.path)
    else:
        raise UsageError(
            f"{args.path} is a {kind}", remedy="reports are made of recordings and bundles; `pans info` shows this"
        )
    replace_file(args.out, page)
    emit(args, {"report": str(args.out), "kind": kind, "bytes": len(page)}, str(args.out))
    return EXIT_FINE


REPORT = Command("one self-contained page of a recording or a bundle", _configure, _run)
