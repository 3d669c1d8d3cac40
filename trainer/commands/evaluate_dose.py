"""`pans evaluate --dose-cap` and `--bleach`: what a bundle decides when an object may receive only so much light.

Owns the two answers: of one cap, and accuracy against dose (`--dose-cap curve`). The figures come from the package evaluate; all of
them are SIMULATED.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError
from pans.runtime.imaging import NO_BLEACHING, Bleaching, bleaching_of
from pans.runtime.ranges import Range

from .arguments import needing
from .course import shown_course

if TYPE_CHECKING:
    from pans.trainer.evaluate.held_out import Conditions, HeldOut

CURVE_WORD = "curve"
DOSE_CAP = Range(1e-9, 1e15)


def dose_cap(text: str) -> float | str:
    """Return what `--dose-cap` stands for: a number, or the word for a curve."""
    return CURVE_WORD if text == CURVE_WORD else float(DOSE_CAP.option(text))


def add_dose(parser: argparse.ArgumentParser) -> None:
    """Add --dose-cap and --bleach to `pans evaluate`."""
    parser.add_argument(
        "--dose-cap",
        type=dose_cap,
        metavar="N|curve",
        help="no object receives more than N photoelectrons of illumination; curve: accuracy against dose",
    )
    parser.add_argument(
        "--bleach",
        metavar="D0[:mixed]",
        help="objects bleach: 1/e of a pixel's light is left after D0 photoelectrons of illumination; mixed: after that mean of all pixels",
    )


def bleaching_given(args: argparse.Namespace) -> Bleaching:
    """Return the law of `--bleach`; ValueError for one that cannot be."""
    return NO_BLEACHING if args.bleach is None else bleaching_of(args.bleach)


def is_dosed(args: argparse.Namespace) -> bool:
    """Whether a cap or bleaching is asked for; UsageError for what contradicts it."""
    asked = args.dose_cap is not None or args.bleach is not None
    if asked and args.shots != 1:
        raise UsageError("--dose-cap and --bleach are of one shot", remedy="leave --shots out")
    if asked and args.draws is not None:
        raise UsageError("--draws has no --dose-cap and no --bleach", remedy="--optics takes one table beside them")
    if args.dose_cap == CURVE_WORD and (args.trials is not None or args.exact):
        raise UsageError("--dose-cap curve takes as few trials as can be", remedy="leave --trials and --exact out")
    return asked


def evaluate_dose(
    args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions
) -> tuple[dict[str, Any], str]:
    """Return the answer for a cap, for samples that bleach, or for both: as JSON and in words."""
    make = _curve if args.dose_cap == CURVE_WORD else _one
    payload, words = make(args, bundle, held_out, conditions)
    return payload | {"bleaching": conditions.bleaching.spelled() or None}, words


def _one(
    args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions
) -> tuple[dict[str, Any], str]:
    from pans.trainer.evaluate.dose import Capped, Knowledge, figures_of, trial_error, within_cap

    if args.exact and bundle.automaton is not None and args.bleach is not None:
        raise UsageError(
            "--exact: what is left of a bleached sample depends on the walk, and walks are sampled",
            remedy="use --trials",
        )
    found = Capped(bundle, 0.0, bundle.n_features, None)
    if args.dose_cap is not None:
        found = within_cap(bundle, args.dose_cap, held_out, Knowledge(bundle, held_out), args.eta)
    measured = asdict(figures_of(found, held_out, conditions, args.trials))
    measured["accuracy_se_trials"] = trial_error(measured)
    capped = {} if args.dose_cap is None else found.facts()
    words = [dose_words(measured, conditions.bleaching)]
    if capped:
        words.append(f"  dose cap {found.cap:g}: at most {found.exposures_most} exposures")
    return measured | capped, "\n".join(words)


def dose_words(measured: Mapping[str, Any], bleaching: Bleaching) -> str:
    """Return the figures of one cap or sample in words."""
    how = f"{measured['trials']} trials" if measured["trials"] else "exact expectation"
    accuracy, spread, error = (
        100 * (measured[name] or 0.0) for name in ("accuracy_mean", "accuracy_std", "accuracy_se_objects")
    )
    return (
        f"SIMULATED accuracy {accuracy:.2f} %  ({measured['objects']} objects, {how}, {bleaching.words()})\n"
        f"  spread over trials      {spread:.2f} points (error of the mean {100 * measured['accuracy_se_trials']:.2f})\n"
        f"  error from the objects  {error:.2f} points\n"
        f"  clicks {measured['clicks_mean']:.3f}   photons {measured['photons_mean']:.2f}   "
        f"illumination {measured['illumination']:.1f}"
    )


def _curve(
    args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions
) -> tuple[dict[str, Any], str]:
    from pans.trainer.evaluate.dose import dose_curve

    with shown_course("caps") as show:
        points = dose_curve(bundle, held_out, conditions, lambda n, of: show(f"cap {n} of {of}", n, n, of, n == of))
    payload: dict[str, Any] = {"objects": len(held_out.objects), "curve": points}
    if args.pictures is not None:
        with needing("--pictures", "plot"):
            from pans.trainer.evaluate.dose_picture import draw_dose

            payload["pictures"] = [str(draw_dose(args.pictures, {bundle.name: points}, force=args.force))]
    return payload, curve_words(bundle.name, len(held_out.objects), conditions.bleaching, points)


_ROWS = (
    ("dose cap", "dose_cap", 1.0, ".6g"),
    ("accuracy (%)", "accuracy_mean", 100.0, ".2f"),
    ("  unbleached", "accuracy_unbleached", 100.0, ".2f"),
    ("  spread over trials", "accuracy_std", 100.0, ".2f"),
    ("  error from objects", "accuracy_se_objects", 100.0, ".2f"),
    ("clicks", "clicks_mean", 1.0, ".3f"),
    ("photons", "photons_mean", 1.0, ".2f"),
    ("illumination", "illumination", 1.0, ".1f"),
)


def curve_words(name: str, objects: int, bleaching: Bleaching, points: Sequence[Mapping[str, Any]]) -> str:
    """Return accuracy against dose as a small table."""
    lines = [f"SIMULATED accuracy of {name} against dose, {objects} objects, {bleaching.words()}"]
    for label, key, factor, form in _ROWS:
        values = [point[key] for point in points]
        if any(value is not None for value in values):
            cells = ("-" if value is None else format(factor * value, form) for value in values)
            lines.append(f"  {label:21s}" + "".join(f"{cell:>9s}" for cell in cells))
    return "\n".join(lines)
