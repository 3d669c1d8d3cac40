"""What a refit came to, as JSON and in words, and what a refitted bundle tells of it.

Owns the keys and the sentences; computes nothing but intervals. An accuracy always stands with clicks, photons and illumination.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pans.runtime.bundle import Bundle
from pans.runtime.intervals import Z_95

from .choosing import FOLDS, OLD, Estimate, Judged, Refitted
from .clicks import Labelled
from .evidence import Evidence


def report_of(bundle: Bundle, clicks: Labelled, evidence: Evidence, found: Refitted, judged: Judged) -> dict[str, Any]:
    """Return the figures as JSON; `held_out` are those of the procedure on objects that it had not seen."""
    seen = np.bincount(evidence.classes, minlength=bundle.n_classes)
    return {
        "chosen": found.name,
        "changed": found.name != OLD,
        "objects": evidence.n_objects,
        "decisions": len(evidence.row),
        "objects_per_class": dict(zip(bundle.classes, seen.tolist())),
        "left_out": clicks.left_out,
        "simulated": clicks.simulated,
        "held_out": {
            "folds": FOLDS,
            "accuracy_old": estimate_json(judged.old_accuracy),
            "accuracy_new": estimate_json(judged.new_accuracy),
            "accuracy_gain": estimate_json(judged.accuracy_gain),
            "log_loss_old": estimate_json(judged.old_loss),
            "log_loss_new": estimate_json(judged.new_loss),
            "log_loss_gain": estimate_json(judged.loss_gain),
            "chosen": list(judged.chosen),
        },
        "kinds": {name: {"log_loss_gain": gain, "error": error} for name, (gain, error) in found.trials.items()},
        "learning_curve": [
            {"objects": size, **estimate_json(accuracy)} for size, accuracy in zip(judged.sizes, judged.curve)
        ],
        "more_objects": {"objects": judged.more_objects, "accuracy_gain": estimate_json(judged.more_gain)},
        "clicks_mean": float(clicks.counts.sum(axis=1).mean()),
        "photons_mean": _known(clicks.light.photons),
        "illumination": _known(clicks.light.illumination),
    }


def provenance_of(
    bundle: Bundle, sha256: str, clicks: Labelled, labels_sha256: str | None, report: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what the new bundle tells of where it comes from."""
    kept = (
        "chosen",
        "objects",
        "decisions",
        "objects_per_class",
        "simulated",
        "held_out",
        "clicks_mean",
        "photons_mean",
    )
    return {
        "from_bundle_sha256": sha256,
        "recordings": list(clicks.sources),
        "labels_sha256": labels_sha256,
        "shots": clicks.shots,
        "expected_of_the_old_instrument": None if bundle.expected is None else dict(bundle.expected),
        **{name: report[name] for name in kept},
        "illumination": report["illumination"],
    }


def words_of(report: Mapping[str, Any]) -> str:
    """Return the report in words."""
    held = report["held_out"]
    kind = "SIMULATED: " if report["simulated"] else ""
    left = ", ".join(f"{count} {why}" for why, count in report["left_out"].items() if count)
    lines = [
        f"{kind}{report['objects']} labelled objects, {report['decisions']} decisions"
        + (f" ({left}: left out)" if left else ""),
        _outcome(report),
        f"on objects held out ({held['folds']} folds; 95 % intervals):",
        f"  accuracy  old {percent_words(held['accuracy_old'])}, new {percent_words(held['accuracy_new'])}, "
        f"gain {percent_words(held['accuracy_gain'], '+')}",
        f"  log loss  old {_plain(held['log_loss_old'])}, new {_plain(held['log_loss_new'])}, gain {_plain(held['log_loss_gain'])}",
        f"  {light_words(report)} per decision",
        "accuracy by the number of labelled objects: "
        + ", ".join(f"{row['objects']}: {100 * row['value']:.1f} %" for row in report["learning_curve"]),
        f"with {report['more_objects']['objects']} objects in all, about "
        f"{percent_words(report['more_objects']['accuracy_gain'], '+')} more",
        *report.get("notes", ()),
        f"{report['bundle']}  SHA-256 {report['sha256'][:16]}",
    ]
    return "\n".join(lines)


def _outcome(report: Mapping[str, Any]) -> str:
    if not report["changed"]:
        return "the old back end stays: no correction is clearly better on objects held out"
    slots = report.get("slots_corrected", 0)
    also = f", and of the states after {slots} of the exposures" if slots else ""
    return f"corrected: {report['chosen']}{also}"


def estimate_json(found: Estimate) -> dict[str, float | None]:
    """Return an estimate with its 95 % interval; None for what is not known."""
    half = Z_95 * found.error
    return {
        "value": _known(found.value),
        "low": _known(found.value - half),
        "high": _known(found.value + half),
        "error": _known(found.error),
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"


def percent_words(found: Mapping[str, float], sign: str = "") -> str:
    """Return an accuracy and its interval in words; with `sign` "+" a gain."""
    value, low, high = (format(100 * found[name] + 0.0, f"{sign}.1f") for name in ("value", "low", "high"))
    return f"{value} ({low} to {high}) %"


def light_words(figures: Mapping[str, Any]) -> str:
    """Return `clicks_mean`, `photons_mean` (None: unknown) and `illumination` of `figures` in words."""
    clicks, photons = _number(figures["clicks_mean"]), _number(figures["photons_mean"])
    return f"at {clicks} clicks, {photons} photons, illumination {_number(figures['illumination'])}"


def _plain(found: Mapping[str, float]) -> str:
    return f"{found['value']:.3f} ({found['low']:.3f} to {found['high']:.3f})"
