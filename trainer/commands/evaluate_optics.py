"""`pans evaluate --optics`: what a bundle decides where the table is not perfect.

Owns the two answers beside that of one given table: means over drawn tables (`--draws`), and accuracy against each misalignment
(`--optics tolerance`). The figures come from the package evaluate; all of them are SIMULATED.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError
from pans.runtime.imaging import Imaging, Tolerance, imaging_of, tolerance_of

from .arguments import needing
from .course import shown_course

if TYPE_CHECKING:
    from pans.trainer.evaluate.held_out import Conditions, HeldOut
    from pans.trainer.evaluate.optics import OverOptics

CURVES_WORD = "tolerance"


def add_optics(parser: argparse.ArgumentParser) -> None:
    """Add --optics and --draws to `pans evaluate`."""
    parser.add_argument(
        "--optics",
        metavar="SPEC",
        help="where objects stand on the pattern grid, like shift=0.7,0.3:rotate=1.5:psf=0.7:black=0.002; tolerance: a curve of each",
    )
    parser.add_argument(
        "--draws",
        type=int,
        metavar="N",
        help="mean over N tables drawn within --optics, read as a tolerance, or within that of the bundle's training",
    )


def several_tables(args: argparse.Namespace) -> bool:
    """Whether more than one table is asked for; UsageError for options that contradict each other."""
    if args.draws is not None and not 1 <= args.draws <= 100_000:
        raise UsageError(f"--draws is {args.draws}, allowed: 1 to 100000")
    if args.draws is not None and args.optics == CURVES_WORD:
        raise UsageError("--draws takes a tolerance, not --optics tolerance", remedy="leave one of them out")
    several = args.draws is not None or args.optics == CURVES_WORD
    if several and (args.trials is not None or args.shots != 1):
        raise UsageError(
            "--draws and --optics tolerance are exact, of one shot", remedy="leave --trials and --shots out"
        )
    return several


def one_table(text: str | None) -> Imaging | None:
    """Return the optics of `--optics` for one table; None: as the profile states."""
    return None if text is None else imaging_of(text)


def evaluate_tables(
    args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions
) -> tuple[dict[str, Any], str]:
    """Return the answer for several tables, as JSON and in words."""
    make = _curves if args.optics == CURVES_WORD else _drawn
    return make(args, bundle, held_out, conditions)


def _drawn(
    args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions
) -> tuple[dict[str, Any], str]:
    from pans.trainer.evaluate.optics import drawn_tables, over_optics

    tolerance = _tolerance(args.optics, bundle)
    tables = drawn_tables(tolerance, args.draws, args.seed)
    with shown_course("tables") as show:
        found = over_optics(
            bundle, held_out, tables, conditions, lambda n, of: show(f"table {n} of {of}", n, n, of, n == of)
        )
    return {"optics": tolerance.as_dict(), **asdict(found)}, over_words(
        found, f"tables drawn within {tolerance.words()}"
    )


def _tolerance(text: str | None, bundle: Bundle) -> Tolerance:
    told = text or _trained_through(bundle)
    if told is None:
        raise UsageError(
            f"--draws: {bundle.name} was trained on perfect optics, and no tolerance is given",
            remedy="--optics shift=1:rotate=2:psf=0.5..0.8:black=0.002, say",
        )
    return tolerance_of(told)


def _trained_through(bundle: Bundle) -> str | None:
    options = bundle.provenance.get("options")
    told = options.get("optics") if isinstance(options, Mapping) else None
    return told if isinstance(told, str) else None


def over_words(found: OverOptics, which: str) -> str:
    """Return means over several tables in words."""
    return (
        f"SIMULATED accuracy {100 * found.accuracy_mean:.2f} %  ({found.objects} objects, {found.tables} {which})\n"
        f"  spread over tables      {100 * found.accuracy_std_optics:.2f} points (error of the mean"
        f" {100 * found.accuracy_se_optics:.2f}), worst table {100 * found.accuracy_worst:.2f} %\n"
        f"  error from the objects  {100 * found.accuracy_se_objects:.2f} points\n"
        f"  clicks {found.clicks_mean:.3f}   photons {found.photons_mean:.2f}   illumination {found.illumination:.1f}"
    )


def _curves(
    args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions
) -> tuple[dict[str, Any], str]:
    from pans.trainer.evaluate.held_out import imaging_on
    from pans.trainer.evaluate.optics import misalignment_curves

    about = imaging_on(held_out, conditions)
    with shown_course("tables") as show:
        curves = misalignment_curves(
            bundle, held_out, about, conditions, lambda n, of: show(f"table {n} of {of}", n, n, of, n == of)
        )
    payload: dict[str, Any] = {"about": about.numbers(), "objects": len(held_out.objects), "curves": curves}
    if args.pictures is not None:
        with needing("--pictures", "plot"):
            from pans.trainer.evaluate.optics_picture import draw_optics

            payload["pictures"] = [str(draw_optics(args.pictures, {bundle.name: curves}, force=args.force))]
    return payload, curve_words(bundle.name, len(held_out.objects), about, curves)


def curve_words(name: str, objects: int, about: Imaging, curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the curves as a small table."""
    lines = [
        f"SIMULATED accuracy of {name} (%), {objects} objects, exact expectation, one misalignment beside {about.words()}"
    ]
    for key, points in curves.items():
        lines.append(f"  {key:13s}" + "".join(f"{point['value']:>9g}" for point in points))
        lines.append(f"  {'':13s}" + "".join(f"{100 * (point['accuracy_mean'] or 0.0):>9.2f}" for point in points))
        lines.append(f"  {'photons':13s}" + "".join(f"{point['photons_mean']:>9.2f}" for point in points))
    return "\n".join(lines)
