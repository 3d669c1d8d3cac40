"""`pans refit`: recordings and labels in; a bundle whose back end is corrected for this instrument, and a report, out."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, Command, add_new_bundle, emit
from pans.runtime.errors import UsageError
from pans.runtime.intervals import Z_95
from pans.runtime.outputs import check_outputs
from pans.runtime.ranges import Range

if TYPE_CHECKING:
    from pans.runtime.bundle import Bundle

    from .choosing import Estimate, Judged, Refitted
    from .clicks import Labelled
    from .evidence import Evidence
    from .rebuild import Rows

CYCLE_RANGE = Range(1, 1 << 32, whole=True)
_JUDGED = ("accuracy_old", "accuracy_new", "accuracy_gain", "log_loss_old", "log_loss_new", "log_loss_gain")
_KEPT = (
    *("chosen", "objects", "decisions", "objects_per_class", "simulated", "held_out"),
    *("clicks_mean", "photons_mean", "illumination"),
)


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
    from .clicks import labelled_clicks, read_labels
    from .rebuild import rebuilt, rows_of

    bundle, sha256 = load_bundle(path)
    labels = None if args.labels is None else read_labels(args.labels, bundle.classes)
    clicks = labelled_clicks(bundle, sha256, args.recordings, labels, args.cycle)
    rows = rows_of(bundle, clicks)
    _demand_enough(rows, bundle.classes)
    kinds = kinds_for(rows.evidence, rows=rows.own_posteriors)
    if not kinds:
        raise UsageError(f"{bundle.n_classes} classes are too many to refit", remedy="refit bundles of fewer classes")
    found, judged = choose(rows.evidence, kinds), judge(rows.evidence, kinds)
    report = _report(bundle, clicks, rows.evidence, found, judged)
    facts = _provenance(bundle, sha256, clicks, None if labels is None else labels.sha256, report)
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


def _report(bundle: Bundle, clicks: Labelled, evidence: Evidence, found: Refitted, judged: Judged) -> dict[str, Any]:
    """The figures as JSON; `held_out` are those of the procedure on objects that it had not seen."""
    import numpy as np

    from .choosing import FOLDS, OLD

    seen = np.bincount(evidence.classes, minlength=bundle.n_classes)
    figures = {name: estimate_json(getattr(judged, name)) for name in _JUDGED}
    curve = zip(judged.sizes, judged.curve)
    return {
        "chosen": found.name,
        "changed": found.name != OLD,
        "objects": evidence.n_objects,
        "decisions": len(evidence.row),
        "objects_per_class": dict(zip(bundle.classes, seen.tolist())),
        "left_out": clicks.left_out,
        "simulated": clicks.simulated,
        "held_out": {"folds": FOLDS, **figures, "chosen": list(judged.chosen)},
        "kinds": {name: {"log_loss_gain": gain, "error": error} for name, (gain, error) in found.trials.items()},
        "learning_curve": [{"objects": size, **estimate_json(accuracy)} for size, accuracy in curve],
        "more_objects": {"objects": 2 * evidence.n_objects, "accuracy_gain": estimate_json(judged.more_gain)},
        "clicks_mean": float(clicks.counts.sum(axis=1).mean()),
        "photons_mean": _known(clicks.photons),
        "illumination": _known(clicks.illumination),
    }


def _provenance(
    bundle: Bundle, sha256: str, clicks: Labelled, labels_sha256: str | None, report: Mapping[str, Any]
) -> dict[str, Any]:
    """Where the new bundle comes from."""
    return {
        "from_bundle_sha256": sha256,
        "recordings": list(clicks.sources),
        "labels_sha256": labels_sha256,
        "shots": clicks.shots,
        "expected_of_the_old_instrument": None if bundle.expected is None else dict(bundle.expected),
        **{name: report[name] for name in _KEPT},
    }


def words_of(report: Mapping[str, Any]) -> str:
    """Return the report in words."""
    held = report["held_out"]
    kind, more = "SIMULATED: " if report["simulated"] else "", report["more_objects"]
    left = ", ".join(f"{count} {why}" for why, count in report["left_out"].items() if count)
    outcome = "the old back end stays: no correction is clearly better on objects held out"
    if report["changed"]:
        slots = report.get("slots_corrected", 0)
        also = f", and of the states after {slots} of the exposures" if slots else ""
        outcome = f"corrected: {report['chosen']}{also}"
    lines = [
        f"{kind}{report['objects']} labelled objects, {report['decisions']} decisions"
        + (f" ({left}: left out)" if left else ""),
        outcome,
        f"on objects held out ({held['folds']} folds; 95 % intervals):",
        f"  accuracy  old {percent_words(held['accuracy_old'])}, new {percent_words(held['accuracy_new'])}, "
        f"gain {percent_words(held['accuracy_gain'], '+')}",
        f"  log loss  old {_plain(held['log_loss_old'])}, new {_plain(held['log_loss_new'])}, gain {_plain(held['log_loss_gain'])}",
        f"  {light_words(report)} per decision",
        "accuracy by the number of labelled objects: "
        + ", ".join(f"{row['objects']}: {100 * row['value']:.1f} %" for row in report["learning_curve"]),
        f"with {more['objects']} objects in all, about {percent_words(more['accuracy_gain'], '+')} more",
        *report.get("notes", ()),
        f"{report['bundle']}  SHA-256 {report['sha256'][:16]}",
    ]
    return "\n".join(lines)


def estimate_json(found: Estimate) -> dict[str, float | None]:
    """Return an estimate with its 95 % interval; None for what is not known."""
    value, half = found.value, Z_95 * found.error
    figures = {"value": value, "low": value - half, "high": value + half, "error": found.error}
    return {name: _known(figure) for name, figure in figures.items()}


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def percent_words(found: Mapping[str, float], sign: str = "") -> str:
    """Return an accuracy and its interval in words; with `sign` "+" a gain."""
    value, low, high = (format(100 * found[name] + 0.0, f"{sign}.1f") for name in ("value", "low", "high"))
    return f"{value} ({low} to {high}) %"


def light_words(figures: Mapping[str, Any]) -> str:
    """Return `clicks_mean`, `photons_mean` (None: unknown) and `illumination` of `figures` in words."""
    found = (figures["clicks_mean"], figures["photons_mean"], figures["illumination"])
    clicks, photons, light = ("unknown" if value is None else f"{value:.4g}" for value in found)
    return f"at {clicks} clicks, {photons} photons, illumination {light}"


def _plain(found: Mapping[str, float]) -> str:
    return f"{found['value']:.3f} ({found['low']:.3f} to {found['high']:.3f})"


REFIT = Command(
    "correct what decides, by recorded clicks of labelled objects of this instrument",
    _configure,
    _run,
    examples=(
        "pans refit fashion10 run.pansrec -o fashion10-here.pans",
        "pans refit my.pans monday.pansrec tuesday.pansrec --labels truth.csv -o my-here.pans",
    ),
)
