"""`pans refit`: what decides, corrected by recorded clicks of labelled objects of this instrument.

Owns the command's arguments and files; what it reports is worded in words.py. The choice is choosing.py's, the new bundle rebuild.py's.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pans.runtime.cli import EXIT_FINE, Command, add_new_bundle, emit
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs
from pans.runtime.ranges import Range

if TYPE_CHECKING:
    from .rebuild import Rows

CYCLE_RANGE = Range(1, 1 << 32, whole=True)


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", type=Path, help="the bundle that the recordings were made with")
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="recordings (.pansrec), or folders with one in parts",
    )
    parser.add_argument(
        "--labels",
        type=Path,
        metavar="CSV",
        help="object,label per line (recording,object,label for several); default: the truth in the recordings",
    )
    parser.add_argument(
        "--cycle",
        type=CYCLE_RANGE.option,
        default=0,
        metavar="N",
        help="the scene starts over after N objects (a simulated one says so itself)",
    )
    add_new_bundle(parser, metavar="NEW.pans")


def _run(args: argparse.Namespace) -> int:
    from pans.runtime.bundle.model import bundle_path, load_bundle, write_bundle

    path = bundle_path(args.bundle)
    check_outputs([args.out], inputs=[path, *args.recordings, args.labels], force=args.force)
    from .choosing import choose, judge, kinds_for
    from .clicks import labelled_clicks
    from .labels import read_labels
    from .rebuild import rebuilt, rows_of
    from .words import provenance_of, report_of, words_of

    bundle, sha256 = load_bundle(path)
    labels = None if args.labels is None else read_labels(args.labels, bundle.classes)
    clicks = labelled_clicks(bundle, sha256, args.recordings, labels, args.cycle)
    rows = rows_of(bundle, clicks)
    _demand_enough(rows, bundle.classes)
    kinds = kinds_for(rows.evidence, rows=rows.own_posteriors)
    if not kinds:
        raise UsageError(f"{bundle.n_classes} classes are too many to refit", remedy="refit bundles of fewer classes")
    found, judged = choose(rows.evidence, kinds), judge(rows.evidence, kinds)
    report = report_of(bundle, clicks, rows.evidence, found, judged)
    facts = provenance_of(bundle, sha256, clicks, None if labels is None else labels.sha256, report)
    new = rebuilt(bundle, rows, found, clicks, facts)
    written = write_bundle(new.bundle, args.out, force=args.force)
    files = {"bundle": str(args.out), "sha256": written}
    more = {"slots_corrected": new.slots_corrected, "notes": list(new.notes)}
    emit(args, files | report | more, words_of(files | report | more))
    return EXIT_FINE


def _demand_enough(rows: Rows, classes: tuple[str, ...]) -> None:
    """Every class of the bundle has objects enough to fit and to judge."""
    import numpy as np

    from .choosing import PER_CLASS_MIN

    seen = np.bincount(rows.evidence.classes, minlength=len(classes))
    few = [f"{name} {count}" for name, count in zip(classes, seen.tolist()) if count < PER_CLASS_MIN]
    if few:
        more = ", ..." if len(few) > 10 else ""
        raise UsageError(
            f"too few labelled objects, allowed: {PER_CLASS_MIN} or more of each class; there are {', '.join(few[:10])}{more}",
            remedy="record and label more objects",
        )


REFIT = Command(
    "correct what decides, by recorded clicks of labelled objects of this instrument",
    _configure,
    _run,
    examples=(
        "pans refit fashion10 run.pansrec -o fashion10-here.pans",
        "pans refit my.pans monday.pansrec tuesday.pansrec --labels truth.csv -o my-here.pans",
    ),
)
