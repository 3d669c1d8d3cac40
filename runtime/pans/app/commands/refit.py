"""`pans refit`: recordings and labels in; a bundle whose back end is corrected for this instrument, and a report, out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.app.command import Command, add_new_bundle
from pans.base.console import emit
from pans.base.errors import EXIT_FINE, UsageError
from pans.base.files import check_outputs
from pans.base.numbers import Range

if TYPE_CHECKING:
    from pans.bundle.sensor import Bundle
    from pans.calibrate.refit import Judged, Labelled, Refitted, Rows

CYCLE_RANGE = Range(1, 1 << 32, whole=True)


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("bundle", type=Path, help="the bundle that the recordings were made with")
    recordings = "recordings (.pansrec), or folders with one in parts"
    add("recordings", type=Path, nargs="+", metavar="RECORDING", help=recordings)
    labels = "object,label per line (recording,object,label for several); default: the truth in the recordings"
    add("--labels", type=Path, metavar="CSV", help=labels)
    cycle = "the scene starts over after N objects (a simulated one says so itself)"
    add("--cycle", type=CYCLE_RANGE.option, default=0, metavar="N", help=cycle)
    add_new_bundle(parser, metavar="NEW.pans")


def _run(args: argparse.Namespace) -> int:
    from pans.bundle.sensor import bundle_path, load_bundle, write_bundle

    path = bundle_path(args.bundle)
    check_outputs([args.out], inputs=[path, *args.recordings, args.labels], force=args.force)
    from pans.calibrate.refit import choose, judge, kinds_for, labelled_clicks, read_labels, rebuilt, rows_of

    bundle, sha256 = load_bundle(path)
    labels = None if args.labels is None else read_labels(args.labels, bundle.classes)
    clicks = labelled_clicks(bundle, sha256, args.recordings, labels, args.cycle)
    rows = rows_of(bundle, clicks)
    _demand_enough(rows, bundle.classes)
    kinds = kinds_for(rows.evidence, rows=rows.own_posteriors)
    if not kinds:
        raise UsageError(f"{bundle.n_classes} classes are too many to refit", remedy="refit bundles of fewer classes")
    found = choose(rows.evidence, kinds)
    report = _report(bundle, clicks, rows, found, judge(rows.evidence, kinds))
    kept = ("chosen", "objects", "decisions", "objects_per_class", "simulated", "held_out", "clicks_mean")
    facts = {
        "from_bundle_sha256": sha256,
        "recordings": list(clicks.sources),
        "labels_sha256": None if labels is None else labels.sha256,
        "shots": clicks.shots,
        "expected_of_the_old_instrument": None if bundle.expected is None else dict(bundle.expected),
        **{name: report[name] for name in (*kept, "photons_mean", "illumination")},
    }
    new = rebuilt(bundle, rows, found, clicks, facts)
    written = {"bundle": str(args.out), "sha256": write_bundle(new.bundle, args.out, force=args.force)}
    payload = written | report | {"slots_corrected": new.slots_corrected, "notes": list(new.notes)}
    emit(args, payload, words_of(payload))
    return EXIT_FINE


def _demand_enough(rows: Rows, classes: tuple[str, ...]) -> None:
    """Every class of the bundle has objects enough to fit and to judge."""
    from pans.calibrate.refit import PER_CLASS_MIN

    seen = rows.evidence.per_class()
    few = [f"{name} {count}" for name, count in zip(classes, seen) if count < PER_CLASS_MIN]
    if few:
        names = ", ".join(few[:10]) + (", ..." if len(few) > 10 else "")
        raise UsageError(
            f"too few labelled objects, allowed: {PER_CLASS_MIN} or more of each class; there are {names}",
            remedy="record and label more objects",
        )


def _report(bundle: Bundle, clicks: Labelled, rows: Rows, found: Refitted, judged: Judged) -> dict[str, Any]:
    """The figures as JSON; `held_out` are those of the procedure on objects that it had not seen."""
    from pans.calibrate.refit import FOLDS, OLD

    evidence = rows.evidence
    return {
        "chosen": found.name,
        "changed": found.name != OLD,
        "objects": evidence.n_objects,
        "decisions": len(evidence.row),
        "objects_per_class": dict(zip(bundle.classes, evidence.per_class())),
        "left_out": clicks.left_out,
        "simulated": clicks.simulated,
        "held_out": {
            "folds": FOLDS,
            **{name: one.as_json() for name, one in judged.figures.items()},
            "chosen": list(judged.chosen),
        },
        "kinds": {name: {"log_loss_gain": gain.value, "error": gain.error} for name, gain in found.trials.items()},
        "learning_curve": [{"objects": n, **accuracy.as_json()} for n, accuracy in zip(judged.sizes, judged.curve)],
        "more_objects": {"objects": 2 * evidence.n_objects, "accuracy_gain": judged.more_gain.as_json()},
        "clicks_mean": float(clicks.counts.sum(axis=1).mean()),
        "photons_mean": clicks.photons,
        "illumination": clicks.illumination,
    }


def words_of(report: Mapping[str, Any]) -> str:
    """Return the report in words."""
    held, more = report["held_out"], report["more_objects"]
    left = ", ".join(f"{count} {why}" for why, count in report["left_out"].items() if count)
    outcome = "the old back end stays: no correction is clearly better on objects held out"
    if report["changed"]:
        slots = report["slots_corrected"]
        outcome = f"corrected: {report['chosen']}" + (
            f", and of the states after {slots} of the exposures" * (slots > 0)
        )
    accuracy = [percent_words(held[f"accuracy_{which}"]) for which in ("old", "new")]
    loss = [
        "{value:.3f} ({low:.3f} to {high:.3f})".format_map(held[f"log_loss_{which}"])
        for which in ("old", "new", "gain")
    ]
    curve = ", ".join(f"{row['objects']}: {100 * row['value']:.1f} %" for row in report["learning_curve"])
    lines = [
        f"{'SIMULATED: ' * report['simulated']}{report['objects']} labelled objects, {report['decisions']} decisions"
        + (f" ({left}: left out)" if left else ""),
        outcome,
        f"on objects held out ({held['folds']} folds; 95 % intervals):",
        f"  accuracy  old {accuracy[0]}, new {accuracy[1]}, gain {percent_words(held['accuracy_gain'], '+')}",
        f"  log loss  old {loss[0]}, new {loss[1]}, gain {loss[2]}",
        f"  {light_words(report)} per decision",
        f"accuracy by the number of labelled objects: {curve}",
        f"with {more['objects']} objects in all, about {percent_words(more['accuracy_gain'], '+')} more",
        *report["notes"],
        f"{report['bundle']}  SHA-256 {report['sha256'][:16]}",
    ]
    return "\n".join(lines)


def percent_words(found: Mapping[str, float], sign: str = "") -> str:
    """Return an accuracy and its interval in words; with `sign` "+" a gain."""
    value, low, high = (format(100 * found[name] + 0.0, f"{sign}.1f") for name in ("value", "low", "high"))
    return f"{value} ({low} to {high}) %"


def light_words(figures: Mapping[str, Any]) -> str:
    """Return `clicks_mean`, `photons_mean` (None: unknown) and `illumination` of `figures` in words."""
    found = (figures["clicks_mean"], figures["photons_mean"], figures["illumination"])
    clicks, photons, light = ("unknown" if value is None else f"{value:.4g}" for value in found)
    return f"at {clicks} clicks, {photons} photons, illumination {light}"


REFIT = Command(
    "correct what decides, by recorded clicks of labelled objects of this instrument",
    _configure,
    _run,
    examples=(
        "pans refit fashion10 run.pansrec -o fashion10-here.pans",
        "pans refit my.pans monday.pansrec tuesday.pansrec --labels truth.csv -o my-here.pans",
    ),
)
