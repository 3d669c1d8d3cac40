"""`pans evaluate`: what a bundle decides on held-out objects, against photons.

Owns the arguments and how the answer looks; the figures come from the package evaluate. All of them are SIMULATED through a profile. A
bundle that returns pictures is judged by SSIM and mean squared error.

`pans evaluate --dose-cap` and `--bleach`: what a bundle decides when an object may receive only so much light.

Owns the two answers: of one cap, and accuracy against dose (`--dose-cap curve`). The figures come from the package evaluate; all of
them are SIMULATED.

`pans evaluate --optics`: what a bundle decides where the table is not perfect.

Owns the two answers beside that of one given table: means over drawn tables (`--draws`), and accuracy against each misalignment
(`--optics tolerance`). The figures come from the package evaluate; all of them are SIMULATED.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pans.runtime.bundle.automaton import CONFIDENCE_RANGE
from pans.runtime.bundle.optics import amplification
from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, add_force, emit, note, warn
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs
from pans.runtime.safe_text import one_line

from .arguments import add_data_dir, needing, usage_errors, warn_of_laws

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle
    from pans.trainer.evaluate.accuracy import Measured, MeasuredPictures
    from pans.trainer.evaluate.held_out import Conditions, HeldOut
    from pans.trainer.evaluate.walks import MeasuredWalks
from collections.abc import Sequence

from pans.runtime.bundle.model import Bundle
from pans.runtime.imaging import NO_BLEACHING, Bleaching, bleaching_of
from pans.runtime.ranges import Range

from .arguments import shown_course

if TYPE_CHECKING:
    from pans.trainer.evaluate.held_out import Conditions, HeldOut
from pans.runtime.imaging import Imaging, Tolerance, imaging_of, tolerance_of

if TYPE_CHECKING:
    from pans.trainer.evaluate.held_out import Conditions, HeldOut
    from pans.trainer.evaluate.optics import OverOptics

RECALLS_SHOWN = 10
LEAST_PHOTONS = 0.01  # per decision: below, nothing can be compared
MADE = 1e-3  # of the light: beyond what W in float32 is off by


PICTURE_FILES = (
    "patterns.png",
    "pictures.png",
    "confusion.png",
    "tsne.png",
    "reliability.png",
    "optics.png",
    "dose.png",
)
CURVE_WORD = "curve"
DOSE_CAP = Range(1e-9, 1e15)
CURVES_WORD = "tolerance"


def _configure_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", metavar="BUNDLE", help="a .pans file, or the name of a shipped bundle")
    parser.add_argument("--task", metavar="T", help="as of `pans train` (default: what the bundle was trained on)")
    parser.add_argument("--profile", metavar="P", help="default: what the bundle was trained for")
    parser.add_argument("--shots", type=int, default=1, metavar="K", help="exposures of every pattern (default 1)")
    way = parser.add_mutually_exclusive_group()
    way.add_argument(
        "--trials", type=int, metavar="N", help="sampled decisions per object (default 30; of an automaton: exact)"
    )
    way.add_argument(
        "--exact", action="store_true", help="sum over all click words or walks: no trials, no sampling error"
    )
    parser.add_argument("--objects", type=int, metavar="N", help="only the first N held-out objects (default: all)")
    parser.add_argument(
        "--dark", type=float, metavar="R", help="dark photoelectrons per exposure, instead of the profile's"
    )
    parser.add_argument("--eta", type=float, default=1.0, metavar="E", help="scale all light by E (default 1)")
    parser.add_argument(
        "--confidence",
        type=CONFIDENCE_RANGE.option,
        default=0.0,
        metavar="C",
        help="of an automaton: decide as soon as a class is this probable, abstain if none is at the end",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the trials (default 0)")
    parser.add_argument(
        "--pictures",
        type=Path,
        metavar="DIR",
        help="draw confusion, a map of the clicks, patterns, reliability (extra plot)",
    )
    add_force(parser)
    add_optics(parser)
    add_dose(parser)
    parser.add_argument(
        "--data-seed", type=int, metavar="N", help="of a drawn task (default: that of the bundle's training)"
    )
    add_data_dir(parser)


def _evaluate(args: argparse.Namespace) -> int:
    from pans.runtime.bundle.model import bundle_path, load_bundle
    from pans.trainer.evaluate.held_out import (
        Conditions,
        afterpulses_in,
        crosstalk_in,
        default_trials,
        held_out_of,
        imaging_on,
        measure,
        walks_on,
    )
    from pans.trainer.evaluate.walks import measured_walks, walk_payload
    from pans.trainer.tasks.registry import remembered_task

    _check_numbers(args)
    if args.pictures is not None:
        with needing("--pictures", "plot"):
            import matplotlib  # noqa: F401 - asked for before the work, not after it
        outputs = [args.pictures / name for name in PICTURE_FILES]
        check_outputs(outputs, inputs=[args.bundle, args.task, args.profile], force=args.force, makes_folders=True)
    bundle, digest = load_bundle(args.bundle)
    if args.exact and bundle.picture_shape is not None:
        raise UsageError("--exact: pictures are compared by trials", remedy="use --trials")
    several, dosed = several_tables(args), is_dosed(args)
    with usage_errors():
        imaging = None if several else one_table(args.optics)
        bleaching = bleaching_given(args)
    given = (args.profile, args.eta, args.dark, args.seed, args.data_seed, args.confidence)
    conditions = Conditions(*given, imaging, bleaching)
    trials = args.trials
    if trials is None and not args.exact and bundle.automaton is None:
        trials = default_trials(bundle)
    more: dict[str, Any] = {}
    with usage_errors():
        task = args.task or remembered_task(bundle.provenance, bundle.task, bundle_path(args.bundle))
        held_out = held_out_of(bundle, task, args.objects, args.data_dir, conditions)
        _check_data_seed(args, held_out)
        assumed = not args.profile and "profile" not in bundle.provenance
        note(f"evaluating {bundle.name} on {held_out.task.name}")
        warn_of_laws(bundle, held_out.profile, eta=args.eta, one_by_one=args.exact and args.shots > 1)
        started = time.perf_counter()
        if several or dosed:
            answer, words = (evaluate_tables if several else evaluate_dose)(args, bundle, held_out, conditions)
            emit(args, answer | _facts(held_out, digest, started), words)
            return EXIT_FINE
        if bundle.automaton is None:
            measured = measure(bundle, held_out, shots=args.shots, trials=trials, conditions=conditions)
        else:
            walks = walks_on(bundle, held_out, shots=args.shots, trials=trials, conditions=conditions)
            measured = measured_walks(walks)
            more = {
                "confidence": args.confidence or None,
                **walk_payload(walks),
                **_compared(bundle, measured, held_out, args),
            }
        more |= passive_light(bundle, held_out)
    payload = {
        **asdict(measured),
        **more,
        "profile_assumed": assumed,
        "optics": imaging_on(held_out, conditions).numbers(),
        "afterpulses": afterpulses_in(bundle, held_out, args.shots, measured.trials),
        "crosstalk": crosstalk_in(bundle, held_out, args.shots, measured.trials),
        **_facts(held_out, digest, started),
    }
    warn_of_majority(payload.get("by_class"), measured.photons_mean)
    if args.pictures:
        payload["pictures"] = _draw(args, bundle, held_out, conditions)
    differences = more.get("expected_differences") or []
    emit(args, payload, "\n".join([words_of(measured, more), _profile_words(bundle, held_out, args), *differences]))
    return EXIT_ALERT if differences else EXIT_FINE


def _check_numbers(args: argparse.Namespace) -> None:
    if args.objects is not None and args.objects < 1:
        raise UsageError(f"--objects is {args.objects}, allowed: 1 or more")
    if args.shots < 1 or args.seed < 0:
        raise UsageError(f"--shots is {args.shots}, --seed is {args.seed}, allowed: from 1, from 0")
    if args.data_seed is not None and args.data_seed < 0:
        raise UsageError(f"--data-seed is {args.data_seed}, allowed: 0 or more")


def _facts(held_out: HeldOut, sha256: str, started: float) -> dict[str, Any]:
    """What every answer tells besides its figures."""
    return {
        "task": held_out.task.name,
        "profile": held_out.profile.name,
        "sha256": sha256,
        "seconds": time.perf_counter() - started,
        "simulated": True,
    }


def _check_data_seed(args: argparse.Namespace, held_out: HeldOut) -> None:
    from pans.trainer.tasks.public_sets import PUBLIC_SETS

    name = held_out.task.name
    if args.data_seed is not None and (held_out.task.split_here or name in PUBLIC_SETS):
        raise UsageError(
            f"--data-seed has no effect on the task {name}", remedy="leave it out: it belongs to drawn tasks"
        )


def _profile_words(bundle: Bundle, held_out: HeldOut, args: argparse.Namespace) -> str:
    """Which profile the figures are for, and whether anybody said so."""
    name = held_out.profile.name
    if args.profile:
        return f"  profile {name}"
    if "profile" in bundle.provenance:
        return f"  profile {name}, which the bundle was trained for"
    return f"  profile {name}, assumed: the bundle names none, and another one gives other figures (--profile)"


def _compared(bundle: Bundle, measured: MeasuredWalks, held_out: HeldOut, args: argparse.Namespace) -> dict[str, Any]:
    """What the bundle says that it achieves, and where that is not what was found under the same conditions."""
    from pans.trainer.evaluate.walks import expected_differences, expected_figures

    same = args.optics is None and args.eta == 1 and args.dark is None and not args.confidence and not measured.trials
    kept = bundle.expected
    if kept is None or not same:
        return {"expected": None if kept is None else dict(kept), "expected_differences": None}
    found = expected_figures(measured, held_out.profile.name, held_out.task.name, str(kept["split"]))
    return {"expected": dict(kept), "expected_differences": expected_differences(kept, found)}


def _draw(args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions) -> list[str]:
    from pans.trainer.evaluate.accuracy import light_of
    from pans.trainer.evaluate.held_out import imaging_on, walks_on

    with needing("--pictures", "plot"):
        from pans.trainer.evaluate.pictures import write_pictures, write_walk_pictures

        objects = held_out.objects
        if bundle.automaton is not None:
            walks = walks_on(bundle, held_out, conditions=conditions)
            return [str(path) for path in write_walk_pictures(args.pictures, bundle, walks, force=args.force)]
        light = light_of(
            bundle,
            held_out.profile,
            objects.images,
            eta=conditions.eta,
            dark=conditions.dark,
            imaging=imaging_on(held_out, conditions),
        )
        written = write_pictures(
            args.pictures, bundle, light, objects, shots=args.shots, seed=args.seed, force=args.force
        )
    return [str(path) for path in written]


def passive_light(bundle: Bundle, held_out: HeldOut) -> dict[str, Any]:
    """Return what a passive sensor's figures stand on: how much light its W makes, and how much must reach real optics for it."""
    if bundle.analyser is None:
        return {}
    reaching = bundle.analyser.reaching(held_out.objects.images)
    return {
        "amplification": amplification(bundle.analyser.kind, bundle.analyser.matrix),
        "reaching_photons": reaching,
    }


def words_of(
    measured: Measured | MeasuredPictures | MeasuredWalks, more: Mapping[str, Any] = MappingProxyType({})
) -> str:
    """Return the figures in words; `more` is `walk_payload` of an automaton."""
    figures: dict[str, Any] = asdict(measured)
    if "exposures_mean" in figures:
        return _walk_words(figures, more)
    classes = "".join(f"\n{line}" for line in class_words(figures.get("by_class")))
    light = f"  clicks {measured.clicks_mean:.3f}   photons {measured.photons_mean:.2f}   illumination {measured.illumination:.1f}"
    if "reaching_photons" in more:
        light += f"\n  {_reaching_words(more)}"
    if "ssim_mean" in figures:
        return (
            f"SIMULATED SSIM {figures['ssim_mean']:.4f}, mean squared error {figures['mse_mean']:.4f}  "
            f"({measured.objects} objects, {measured.trials} trials, K = {measured.shots})\n"
            f"  spread over trials      {figures['ssim_std']:.4f}\n"
            f"  error from the objects  {figures['ssim_se_objects']:.4f}\n{light}"
        )
    how = f"{measured.trials} trials" if measured.trials else "exact expectation"
    return (
        f"SIMULATED accuracy {100 * figures['accuracy_mean']:.2f} %  ({measured.objects} objects, {how}, K = {measured.shots})\n"
        f"  spread over trials      {100 * figures['accuracy_std']:.2f} points\n"
        f"  error from the objects  {100 * figures['accuracy_se_objects']:.2f} points\n{light}{classes}"
    )


def class_words(found: Mapping[str, Any] | None) -> list[str]:
    """Return how the decisions fall among the classes, in lines; `found` is accuracy.ByClass as a dict."""
    if found is None:
        return []
    recall = sorted(found["recall"].items(), key=lambda one: (one[1] is None, one[1]))  # the worst first
    shown = ", ".join(f"{one_line(name, 40)} {_percent(share)} %" for name, share in recall[:RECALLS_SHOWN])
    more = f", and {len(recall) - RECALLS_SHOWN} higher" if len(recall) > RECALLS_SHOWN else ""
    return [
        f"  the largest class alone {_percent(found['majority_share'])} %  ({one_line(found['majority_class'], 40)!r}); "
        f"beyond it {_points(found['above_majority'])} ± {100 * found['above_majority_se']:.2f} points",
        f"  balanced accuracy       {_percent(found['balanced_accuracy'])} %; recall {shown}{more}",
    ]


def warn_of_majority(found: Mapping[str, Any] | None, photons: float) -> None:
    """Warn where the sensor tells no more than always naming the largest class."""
    if found is None or found["better_than_majority"]:
        return
    dark = "" if photons >= LEAST_PHOTONS else ": it sends no light"
    warn(
        f"on held-out objects the sensor is not better than always naming the largest class, {one_line(found['majority_class'], 40)!r} "
        f"({_points(found['above_majority'])} ± {100 * found['above_majority_se']:.2f} points, wanted more than two standard "
        f"errors){dark}. Try more light (--photons), more --epochs, or as many objects of each class"
    )


def _reaching_words(more: Mapping[str, Any]) -> str:
    words = f"at least {more['reaching_photons']:,.0f} photoelectrons per object must reach the optics"
    if more["amplification"] > 1 + MADE:
        words += f": W is unconstrained and gives up to {more['amplification']:,.3g} times its light"
    return words


def _walk_words(figures: Mapping[str, Any], more: Mapping[str, Any]) -> str:
    how = f"{figures['trials']} trials" if figures["trials"] else "exact expectation"
    lines = [
        f"SIMULATED accuracy {_percent(figures['accuracy_mean'])} %  ({figures['objects']} objects, {how}, automaton)",
        f"  spread over trials      {_percent(figures['accuracy_std'])} points",
        f"  error from the objects  {_percent(figures['accuracy_se_objects'])} points",
        f"  calibration error       {_percent(figures['expected_calibration_error'])} points",
        _light_words(figures),
        *class_words(figures["by_class"]),
    ]
    if figures["abstained"]:
        lines.append(f"  abstained {100 * figures['abstained']:.2f} %; the accuracy is that of what was decided")
    for name, first in more.items():
        if name.startswith("first_") and first is not None:
            lines.append(f"  the first {first['objects']}: {_percent(first['accuracy_mean'])} %\n{_light_words(first)}")
    return "\n".join(lines)


def _points(difference: float) -> str:
    return f"{round(100 * difference, 2) + 0.0:+.2f}"  # no minus before a zero


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f}"


def _light_words(figures: Mapping[str, Any]) -> str:
    return (
        f"  clicks {figures['clicks_mean']:.3f}   photons {figures['photons_mean']:.2f}   "
        f"illumination {figures['illumination']:.1f}   exposures {figures['exposures_mean']:.2f}"
    )


EVALUATE = Command(
    "accuracy of a bundle against photons, sampled or exact",
    _configure_evaluate,
    _evaluate,
    examples=(
        "pans evaluate parts.pans --exact",
        "pans evaluate parts.pans --profile my-lab.toml --shots 3",
        "pans evaluate parts.pans --dose-cap curve --bleach 40",
    ),
)


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
            from pans.trainer.evaluate.pictures import draw_dose

            payload["pictures"] = [str(draw_dose(args.pictures, {bundle.name: points}, force=args.force))]
    return payload, dose_curve_words(bundle.name, len(held_out.objects), conditions.bleaching, points)


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


def dose_curve_words(name: str, objects: int, bleaching: Bleaching, points: Sequence[Mapping[str, Any]]) -> str:
    """Return accuracy against dose as a small table."""
    lines = [f"SIMULATED accuracy of {name} against dose, {objects} objects, {bleaching.words()}"]
    for label, key, factor, form in _ROWS:
        values = [point[key] for point in points]
        if any(value is not None for value in values):
            cells = ("-" if value is None else format(factor * value, form) for value in values)
            lines.append(f"  {label:21s}" + "".join(f"{cell:>9s}" for cell in cells))
    return "\n".join(lines)


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
            from pans.trainer.evaluate.pictures import draw_optics

            payload["pictures"] = [str(draw_optics(args.pictures, {bundle.name: curves}, force=args.force))]
    return payload, optics_curve_words(bundle.name, len(held_out.objects), about, curves)


def optics_curve_words(
    name: str, objects: int, about: Imaging, curves: Mapping[str, Sequence[Mapping[str, Any]]]
) -> str:
    """Return the curves as a small table."""
    lines = [
        f"SIMULATED accuracy of {name} (%), {objects} objects, exact expectation, one misalignment beside {about.words()}"
    ]
    for key, points in curves.items():
        lines.append(f"  {key:13s}" + "".join(f"{point['value']:>9g}" for point in points))
        lines.append(f"  {'':13s}" + "".join(f"{100 * (point['accuracy_mean'] or 0.0):>9.2f}" for point in points))
        lines.append(f"  {'photons':13s}" + "".join(f"{point['photons_mean']:>9.2f}" for point in points))
    return "\n".join(lines)
