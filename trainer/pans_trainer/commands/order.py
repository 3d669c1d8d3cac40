"""`pans order`: show the patterns of a bundle in the order that tells most first, or only as many as a dose allows. SIMULATED."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.app.command import Command, add_new_bundle
from pans.base.console import emit, note
from pans.base.errors import EXIT_FINE, UsageError, as_usage_error
from pans.base.files import check_outputs

from .arguments import add_data_dir, needing
from .evaluate import DOSE_CAP, bleaching_given

if TYPE_CHECKING:
    from pans.bundle.sensor import Bundle
    from pans_trainer.export.ordering import Order

WAYS = ("information", "dose")


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", metavar="BUNDLE", help="a .pans file, or the name of a shipped bundle")
    words = (
        "most information per pattern, or per light that it sends; none: leave the order as it is (default information)"
    )
    parser.add_argument("--by", choices=(*WAYS, "none"), default="information", help=words)
    words = "keep only the first patterns, as many as stay below N photoelectrons of illumination"
    parser.add_argument("--dose-cap", type=DOSE_CAP.option, metavar="N", help=words)
    parser.add_argument("--bleach", metavar="D0[:mixed]", help="order for objects that bleach, as of `pans evaluate`")
    parser.add_argument("--task", metavar="T", help="as of `pans train` (default: what the bundle was trained on)")
    parser.add_argument("--profile", metavar="P", help="default: what the bundle was trained for")
    add_data_dir(parser)
    add_new_bundle(parser)


def _order(args: argparse.Namespace) -> int:
    from pans.bundle.sensor import bundle_path, load_bundle, write_bundle
    from pans_trainer.evaluate.dose import of_first, patterns_within, training_readings
    from pans_trainer.evaluate.held_out import held_out_of, trained_bleaching
    from pans_trainer.export.ordering import information_order, order_facts, reordered
    from pans_trainer.options import Conditions
    from pans_trainer.tasks.registry import remembered_task

    check_outputs([args.out], inputs=[args.bundle, args.task, args.profile], force=args.force)
    if args.by == "none" and args.dose_cap is None:
        raise UsageError("--by none without --dose-cap changes nothing", remedy="give one of them")
    bundle, _ = load_bundle(args.bundle)
    if bundle.automaton is not None:
        what = f"{bundle.name} has an automaton: its clicks choose the order"
        raise UsageError(what, remedy="pans run --dose-cap keeps it within a dose")
    if args.by != "none" and not trained_bleaching(bundle).is_none:
        what = f"{bundle.name} was trained through bleaching: its back end expects what the patterns before have left"
        raise UsageError(what, remedy="--by none --dose-cap N keeps the first patterns")
    with as_usage_error():
        bleaching = bleaching_given(args)
        task = args.task or remembered_task(bundle.provenance, bundle.task, bundle_path(args.bundle))
        held_out = held_out_of(bundle, task, 1, args.data_dir, Conditions(args.profile))
        note(f"ordering {bundle.name} by the training images of {held_out.task.name}")
        new, order = bundle, None
        if args.by != "none":
            order = information_order(bundle, held_out.profile, held_out.task.train, by=args.by, bleaching=bleaching)
            with needing("a head in eight bits", "train"):
                new = reordered(bundle, order.patterns, order_facts(order, bundle))
        kept = new.n_features
        if args.dose_cap is not None:
            kept = patterns_within(new, args.dose_cap)
            new = of_first(new, kept, training_readings(new, held_out.profile, held_out.task.train))
    digest = write_bundle(new, args.out, force=args.force)
    rows = _rows(bundle, order, kept)
    payload = {"bundle": str(args.out), "sha256": digest, "by": args.by, "patterns": rows, "dose_cap": args.dose_cap}
    payload |= {key: None if order is None else getattr(order, key) for key in ("exact", "objects")}
    payload |= {"illumination": new.illumination(), "bleaching": bleaching.spelled() or None, "simulated": True}
    emit(args, payload, "\n".join(_lines(args.out, digest, rows, order, new)))
    return EXIT_FINE


def _rows(bundle: Bundle, order: Order | None, kept: int) -> list[dict[str, Any]]:
    """What is shown in turn: pattern numbers of the bundle that was given, information and illumination so far."""
    places = range(bundle.n_features) if order is None else order.patterns
    light = bundle.patterns().sum(axis=1)
    rows, dose = [], 0.0
    for number, place in enumerate(places):
        dose += float(light[place])
        bits = None if order is None else order.bits[number]
        rows.append({"pattern": int(place), "bits": bits, "illumination": dose, "kept": number < kept})
    return rows


def _lines(out: Path, digest: str, rows: Sequence[dict[str, Any]], order: Order | None, new: Bundle) -> list[str]:
    lines = [f"{out}  SHA-256 {digest}", f"  {new.n_features} patterns, illumination {new.illumination():.6g}"]
    if order is not None:
        how = "exact over" if order.exact else "sampled on"
        lines.append(f"  SIMULATED information about the class by {order.by}, {how} {order.objects} training images:")
    for row in rows:
        bits = "" if row["bits"] is None else f"{row['bits']:8.4f} bits"
        left = "" if row["kept"] else "   left out"
        lines.append(f"  pattern {row['pattern']:4d}{bits}   illumination so far {row['illumination']:9.2f}{left}")
    return lines


ORDER = Command(
    "show fixed patterns in the order that tells most first, within a dose",
    _configure,
    _order,
    examples=("pans order fashion10 -o ordered.pans", "pans order fashion10 --by dose --dose-cap 60 -o dim.pans"),
)
