"""`pans evaluate`: what a bundle decides on held-out objects, against photons, optics (`--optics`, `--draws`) or dose (`--dose-cap`).

All figures are SIMULATED through a profile. A bundle that returns pictures is judged by SSIM and mean squared error.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pans.app.command import Command, add_force
from pans.base.console import add_options, emit, note, one_line, options_from, warn
from pans.base.errors import EXIT_ALERT, EXIT_FINE, UsageError, as_usage_error
from pans.base.files import check_outputs
from pans.base.numbers import Range
from pans.bundle.sensor import Bundle, amplification
from pans.instrument.optics import NO_BLEACHING, Bleaching, Imaging, bleaching_of, imaging_of, tolerance_of
from pans_trainer.options import LEAST_PHOTONS, Conditions

from .arguments import add_data_dir, displayed_parts, needing, warn_of_laws

if TYPE_CHECKING:
    from pans_trainer.evaluate.accuracy import Measured, MeasuredPictures
    from pans_trainer.evaluate.held_out import HeldOut
    from pans_trainer.evaluate.walks import MeasuredWalks
    from pans_trainer.tasks.registry import Task

RECALLS_SHOWN = 10
MADE = 1e-3  # of the light: beyond what W in float32 is off by
PICTURES = ("patterns", "pictures", "confusion", "tsne", "reliability", "optics", "dose")
COMPARED_UNASKED = 1e11  # numbers that a comparison goes through, at most: some seconds
CURVE_WORD, CURVES_WORD, WHOLE_WORD = "curve", "tolerance", "whole"  # of --dose-cap, --optics and --draws
DOSE_CAP, DRAWS = Range(1e-9, 1e15), Range(1, 100_000, whole=True)
COUNT = Range(1, 1 << 30, whole=True)


def number_or(word: str, allowed: Range) -> Callable[[str], Any]:
    """Return the `type` of an option that stands for a number or for `word`."""
    return lambda text: word if text == word else allowed.option(text)


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", metavar="BUNDLE", help="a .pans file, or the name of a shipped bundle")
    parser.add_argument("--task", metavar="T", help="as of `pans train` (default: what the bundle was trained on)")
    words = "exposures of every pattern (default 1)"
    parser.add_argument("--shots", type=COUNT.option, default=1, metavar="K", help=words)
    way = parser.add_mutually_exclusive_group()
    words = "sampled decisions per object (default 30; of an automaton: exact)"
    way.add_argument("--trials", type=COUNT.option, metavar="N", help=words)
    words = "sum over all click words or walks: no trials, no sampling error"
    way.add_argument("--exact", action="store_true", help=words)
    words = "only the first N held-out objects (default: all)"
    parser.add_argument("--objects", type=COUNT.option, metavar="N", help=words)
    add_options(parser, Conditions)
    words = "draw confusion, a map of the clicks, patterns, reliability (extra plot)"
    parser.add_argument("--pictures", type=Path, metavar="DIR", help=words)
    add_force(parser)
    words = "where objects stand on the pattern grid, like shift=0.7,0.3:rotate=1.5:psf=0.7:black=0.002; tolerance: a curve of each"
    parser.add_argument("--optics", metavar="SPEC", help=words)
    words = "mean over N tables drawn within --optics, read as a tolerance, or that of the training; whole: over all whole-pixel shifts"
    parser.add_argument("--draws", type=number_or(WHOLE_WORD, DRAWS), metavar="N|whole", help=words)
    words = "no object receives more than N photoelectrons of illumination; curve: accuracy against dose"
    parser.add_argument("--dose-cap", type=number_or(CURVE_WORD, DOSE_CAP), metavar="N|curve", help=words)
    words = "objects bleach: 1/e of a pixel's light is left after D0 photoelectrons of illumination; mixed: after that mean of all pixels"
    parser.add_argument("--bleach", metavar="D0[:mixed]", help=words)
    words = "with direct imaging, an ideal camera, at equal photons and equal illumination (default: where that takes seconds)"
    parser.add_argument("--compare", action=argparse.BooleanOptionalAction, help=words)
    add_data_dir(parser)


def _evaluate(args: argparse.Namespace) -> int:
    from pans.bundle.sensor import bundle_path, load_bundle
    from pans_trainer.evaluate import held_out as h
    from pans_trainer.evaluate.walks import measured_walks, walk_payload
    from pans_trainer.tasks.public_sets import PUBLIC_SETS
    from pans_trainer.tasks.registry import remembered_task

    if args.pictures is not None:
        with needing("--pictures", "plot"):
            import matplotlib  # noqa: F401 - asked for before the work, not after it
        outputs = [args.pictures / f"{name}.png" for name in PICTURES]
        check_outputs(outputs, inputs=[args.bundle, args.task, args.profile], force=args.force, makes_folders=True)
    bundle, digest = load_bundle(args.bundle)
    if args.exact and bundle.picture_shape is not None:
        raise UsageError("--exact: pictures are compared by trials", remedy="use --trials")
    make_other, trials = other_answer(args), args.trials
    if trials is None and not args.exact and bundle.automaton is None:
        trials = h.default_trials(bundle)
    more: dict[str, Any] = {}
    with as_usage_error():
        given = args.optics is not None and args.draws is None and args.optics != CURVES_WORD
        imaging = imaging_of(args.optics) if given else None
        conditions = options_from(args, Conditions, imaging=imaging, bleaching=bleaching_given(args))
        task = args.task or remembered_task(bundle.provenance, bundle.task, bundle_path(args.bundle))
        held_out = h.held_out_of(bundle, task, args.objects, args.data_dir, conditions)
        name = held_out.task.name
        if args.data_seed is not None and (held_out.task.split_here or name in PUBLIC_SETS):
            remedy = "leave it out: it belongs to drawn tasks"
            raise UsageError(f"--data-seed has no effect on the task {name}", remedy=remedy)
        note(f"evaluating {bundle.name} on {held_out.task.name}")
        warn_of_laws(bundle, held_out.profile, eta=args.eta, one_by_one=args.exact and args.shots > 1)
        started = time.perf_counter()

        def answered(answer: Mapping[str, Any], words: str) -> None:
            facts = {"task": held_out.task.name, "profile": held_out.profile.name, "sha256": digest}
            emit(args, {**answer, **facts, "seconds": time.perf_counter() - started, "simulated": True}, words)

        if make_other is not None:
            answered(*make_other(args, bundle, held_out, conditions))
            return EXIT_FINE
        if bundle.automaton is None:
            measured = h.measure(bundle, held_out, shots=args.shots, trials=trials, conditions=conditions)
        else:
            walks = h.walks_on(bundle, held_out, shots=args.shots, trials=trials, conditions=conditions)
            measured = measured_walks(walks)
            compared = _compared(bundle, measured, held_out, args)
            more = {"confidence": args.confidence or None, **walk_payload(walks), **compared}
        more |= passive_light(bundle, held_out)
        direct, beside = _beside(bundle, held_out, args, asdict(measured))
    payload = {
        **asdict(measured),
        **more,
        **direct,
        "profile_assumed": not args.profile and "profile" not in bundle.provenance,
        "optics": conditions.imaging_on(held_out.profile).numbers(),
        "afterpulses": h.afterpulses_in(bundle, held_out, args.shots, measured.trials),
        "crosstalk": h.crosstalk_in(bundle, held_out, args.shots, measured.trials),
    }
    warn_of_majority(payload.get("by_class"), measured.photons_mean)
    if args.pictures:
        payload["pictures"] = _draw(args, bundle, held_out, conditions)
    differences = more.get("expected_differences") or []
    lines = [words_of(measured, more), _profile_words(bundle, held_out, args), *beside, *differences]
    answered(payload, "\n".join(lines))
    return EXIT_ALERT if differences else EXIT_FINE


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
    from pans.bundle.sensor import expected_differences
    from pans_trainer.evaluate.walks import expected_figures

    same = args.optics is None and args.eta == 1 and args.dark is None and not args.confidence and not measured.trials
    kept = bundle.expected
    if kept is None or not same:
        return {"expected": None if kept is None else dict(kept), "expected_differences": None}
    found = expected_figures(measured, held_out.profile.name, held_out.task.name, str(kept["split"]))
    return {"expected": dict(kept), "expected_differences": expected_differences(kept, found)}


def _beside(
    bundle: Bundle, held_out: HeldOut, args: argparse.Namespace, figures: Mapping[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """What direct imaging decides on as much light, where that can be told and takes seconds or is asked for."""
    from pans_trainer.baselines.rows import comparison_numbers

    task = held_out.task
    why = "training images are not at hand" if not held_out.apart else ""
    if task.target != "class" or task.light != "transmission":
        why = "only classes of objects that are lit are compared"
    if args.compare and why:
        raise UsageError(f"--compare: {why}", remedy="leave it out")
    if why or args.compare is False:
        return {}, []
    shown = replace(task, test=held_out.objects)
    if "variation" in bundle.provenance:
        if not args.compare and find_spec("torch") is None:
            return {}, []
        with needing("--compare", "train"):
            from pans_trainer.own_images.recipe import as_trained_on
        shown = as_trained_on(shown, bundle.provenance)
    if not args.compare and comparison_numbers(shown) > COMPARED_UNASKED:
        return {}, []
    return direct_imaging(shown, figures, args.seed)


def direct_imaging(task: Task, figures: Mapping[str, Any], seed: int) -> tuple[dict[str, Any], list[str]]:
    """Return what direct imaging decides on the test objects of `task` with the light of `figures`, as JSON and in lines."""
    if task.light != "transmission" or figures["photons_mean"] < LEAST_PHOTONS:
        return {}, []
    from pans_trainer.baselines.rows import at_equal_light, equal_light_figures

    with displayed_parts() as report:
        report("direct imaging with as much light", 0.0)
        done = at_equal_light(task, figures["photons_mean"], figures["illumination"], report, seed=seed)
    found = {name: equal_light_figures(one) for name, one in done.items()}
    same = {"direct_imaging": "photons", "direct_imaging_as_illuminated": "illumination"}
    lines = [
        f"  at equal {same[name]:13s}{_percent(one['accuracy_mean'])} %  (error from the objects "
        f"{_percent(one['accuracy_se_objects'])} points)\n  {_light_words(one)}"
        for name, one in found.items()
    ]
    return found, ["SIMULATED direct imaging, the exact posterior of an ideal camera:", *lines]


def _draw(args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions) -> list[str]:
    from pans_trainer.evaluate.accuracy import light_of
    from pans_trainer.evaluate.held_out import walks_on

    with needing("--pictures", "plot"):
        from pans_trainer.evaluate.pictures import write_pictures, write_walk_pictures

        objects = held_out.objects
        if bundle.automaton is not None:
            walks = walks_on(bundle, held_out, conditions=conditions)
            written = write_walk_pictures(args.pictures, bundle, walks, force=args.force)
        else:
            imaging = conditions.imaging_on(held_out.profile)
            light = light_of(bundle, held_out.profile, objects.images, eta=args.eta, dark=args.dark, imaging=imaging)
            how = {"shots": args.shots, "seed": args.seed, "force": args.force}
            written = write_pictures(args.pictures, bundle, light, objects, **how)
    return [str(path) for path in written]


def passive_light(bundle: Bundle, held_out: HeldOut) -> dict[str, Any]:
    """Return what a passive sensor's figures stand on: how much light its W makes, and how much must reach real optics for it."""
    if bundle.analyser is None:
        return {}
    reaching = bundle.analyser.reaching(held_out.objects.images)
    return {"amplification": amplification(bundle.analyser.kind, bundle.analyser.matrix), "reaching_photons": reaching}


def words_of(
    measured: Measured | MeasuredPictures | MeasuredWalks, more: Mapping[str, Any] = MappingProxyType({})
) -> str:
    """Return the figures in words; `more` is `walk_payload` of an automaton, or `passive_light`."""
    figures: dict[str, Any] = asdict(measured)
    walks = "exposures_mean" in figures
    if "ssim_mean" in figures:
        lines = [
            f"SIMULATED SSIM {figures['ssim_mean']:.4f}, mean squared error {figures['mse_mean']:.4f}  "
            f"({measured.objects} objects, {measured.trials} trials, K = {measured.shots})",
            f"  spread over trials      {figures['ssim_std']:.4f}",
            f"  error from the objects  {figures['ssim_se_objects']:.4f}",
        ]
    else:
        lines = _accuracy_lines(figures, f"{_how(figures)}, {'automaton' if walks else f'K = {measured.shots}'}")
    if walks:
        lines.append(f"  calibration error       {_percent(figures['expected_calibration_error'])} points")
    lines.append(_light_words(figures))
    if figures.get("bits") is not None:
        lines.append(f"  {bit_words(figures)}")
    if "reaching_photons" in more:
        lines.append(f"  {_reaching_words(more)}")
    lines += class_words(figures.get("by_class"))
    if figures.get("abstained"):
        of = "the accuracy is that of what was decided, clicks and light are those of all"
        lines.append(f"  abstained {100 * figures['abstained']:.2f} %; {of}")
    for name, first in more.items():
        if name.startswith("first_") and first is not None:
            lines.append(f"  the first {first['objects']}: {_percent(first['accuracy_mean'])} %\n{_light_words(first)}")
    return "\n".join(lines)


def _accuracy_lines(
    figures: Mapping[str, Any], which: str, over: str = "trials", spread: str = "accuracy_std", more: str = ""
) -> list[str]:
    """Accuracy with both of its errors; `spread` is the key of that over trials or tables."""
    return [
        f"SIMULATED accuracy {_percent(figures['accuracy_mean'])} %  ({figures['objects']} objects, {which})",
        f"  spread over {over}      {_percent(figures[spread])} points{more}",
        f"  error from the objects  {_percent(figures['accuracy_se_objects'])} points",
    ]


def bit_words(figures: Mapping[str, Any]) -> str:
    """Return what the posteriors convey of the class, and per unit of light where there is some; `figures` hold information.Conveyed."""
    words = f"at least {figures['bits']:.3f} ± {figures['bits_se']:.3f} bits of the class"
    for key, unit in (("bits_per_photon", "photon"), ("bits_per_illumination", "unit of illumination")):
        if figures[key] is not None:
            words += f", {figures[key]:.4f} ± {figures[f'{key}_se']:.4f} per {unit}"
    return words


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


def _points(difference: float) -> str:
    return f"{round(100 * difference, 2) + 0.0:+.2f}"  # no minus before a zero


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f}"


def _how(figures: Mapping[str, Any]) -> str:
    return f"{figures['trials']} trials" if figures["trials"] else "exact expectation"


def _light_words(figures: Mapping[str, Any]) -> str:
    exposures = f"   exposures {figures['exposures_mean']:.2f}" if "exposures_mean" in figures else ""
    return (
        f"  clicks {figures['clicks_mean']:.3f}   photons {figures['photons_mean']:.2f}   "
        f"illumination {figures['illumination']:.1f}{exposures}"
    )


# ---- several tables (--draws, --optics tolerance), a dose cap, samples that bleach ----

Answer = tuple[dict[str, Any], str]  # as JSON and in words
Points = Sequence[Mapping[str, Any]]
Row = tuple[str, str, float, str]  # of a small table: label, key of a point, factor, format


def other_answer(args: argparse.Namespace) -> Callable[..., Answer] | None:
    """Return what makes the answer in place of plain figures, or None; UsageError for options that contradict each other."""
    draws, curves, caps = args.draws is not None, args.optics == CURVES_WORD, args.dose_cap == CURVE_WORD
    dosed, sampled = args.dose_cap is not None or args.bleach is not None, args.trials is not None
    for wrong, words, remedy in (
        (draws and curves, "--draws takes a tolerance, not --optics tolerance", "leave one of them out"),
        (
            (draws or curves) and (sampled or args.shots != 1),
            "--draws and --optics tolerance are exact, of one shot",
            "leave --trials and --shots out",
        ),
        (dosed and args.shots != 1, "--dose-cap and --bleach are of one shot", "leave --shots out"),
        (dosed and draws, "--draws has no --dose-cap and no --bleach", "--optics takes one table beside them"),
        (
            caps and (sampled or args.exact),
            "--dose-cap curve takes as few trials as can be",
            "leave --trials and --exact out",
        ),
    ):
        if wrong:
            raise UsageError(words, remedy=remedy)
    if draws or curves:
        return _over_draws if draws else _misaligned
    return (_dose_curve if caps else _within_dose) if dosed else None


def bleaching_given(args: argparse.Namespace) -> Bleaching:
    """Return the law of `--bleach`; ValueError for one that cannot be."""
    return NO_BLEACHING if args.bleach is None else bleaching_of(args.bleach)


@contextmanager
def _counted(what: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a report of how many are done, of how many."""
    with displayed_parts() as report:
        yield lambda n, of: report(f"{what} {n} of {of}", n / of)


def _over_draws(args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions) -> Answer:
    from pans_trainer.evaluate.optics import drawn_tables, over_optics, whole_shifts

    options, whole = bundle.provenance.get("options"), args.draws == WHOLE_WORD
    trained = options if isinstance(options, Mapping) else {}
    right, down = trained.get("shift_px"), trained.get("offset_px")
    moved = f"shift=-{right}..{right},-{down}..{down}" if whole and (right or down) else None
    text = args.optics or trained.get("optics") or moved
    if not isinstance(text, str):
        what = f"--draws: {bundle.name} was trained on perfect optics, and no tolerance is given"
        raise UsageError(what, remedy="--optics shift=1:rotate=2:psf=0.5..0.8:black=0.002, say")
    tolerance = tolerance_of(text)
    with _counted("table") as report:
        tables = whole_shifts(tolerance) if whole else drawn_tables(tolerance, args.draws, args.seed)
        found = asdict(over_optics(bundle, held_out, tables, conditions, report))
    if whole:
        found["accuracy_se_optics"] = 0.0  # they are all
    which = f"{found['tables']} {'shifts by whole pixels' if whole else 'tables drawn'} within {tolerance.words()}"
    more = f" (error of the mean {_percent(found['accuracy_se_optics'])}), worst table {_percent(found['accuracy_worst'])} %"
    lines = _accuracy_lines(found, which, "tables", "accuracy_std_optics", more)
    return {"optics": tolerance.as_dict(), **found}, "\n".join([*lines, _light_words(found)])


def _misaligned(args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions) -> Answer:
    from pans_trainer.evaluate.optics import misalignment_curves

    about, objects = conditions.imaging_on(held_out.profile), len(held_out.objects)
    with _counted("table") as report:
        curves = misalignment_curves(bundle, held_out, about, conditions, report)
    payload: dict[str, Any] = {"about": about.numbers(), "objects": objects, "curves": curves}
    if args.pictures is not None:
        from pans_trainer.evaluate.pictures import draw_optics

        payload["pictures"] = [str(draw_optics(args.pictures, {bundle.name: curves}, force=args.force))]
    return payload, optics_curve_words(bundle.name, objects, about, curves)


def optics_curve_words(name: str, objects: int, about: Imaging, curves: Mapping[str, Points]) -> str:
    """Return accuracy against each misalignment as small tables."""
    head = f"SIMULATED accuracy of {name} (%), {objects} objects, exact expectation, one misalignment beside {about.words()}"
    rows: tuple[Row, ...] = (("accuracy (%)", "accuracy_mean", 100.0, ".2f"), ("photons", "photons_mean", 1.0, ".2f"))
    lines = [line for key, points in curves.items() for line in _point_lines(((key, "value", 1.0, "g"), *rows), points)]
    return "\n".join([head, *lines])


def _within_dose(args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions) -> Answer:
    from pans_trainer.evaluate.dose import Capped, depends_on_walk, figures_of, knowledge_of, trial_error, within_cap

    if args.exact and depends_on_walk(bundle, conditions):
        what = "--exact: what is left of a bleached sample depends on the walk, and walks are sampled"
        raise UsageError(what, remedy="use --trials")
    found = Capped(bundle, 0.0, bundle.n_features, None)
    if args.dose_cap is not None:
        found = within_cap(bundle, args.dose_cap, held_out, knowledge_of(bundle, held_out), args.eta)
    measured = asdict(figures_of(found, held_out, conditions, args.trials))
    measured["accuracy_se_trials"] = trial_error(measured)
    which = f"{_how(measured)}, {conditions.bleaching.words()}"
    more = f" (error of the mean {_percent(measured['accuracy_se_trials'])})"
    lines = [*_accuracy_lines(measured, which, more=more), _light_words(measured)]
    answer = measured | {"bleaching": conditions.bleaching.spelled() or None}
    if args.dose_cap is not None:
        answer |= found.facts()
        lines.append(f"  dose cap {found.cap:g}: at most {found.exposures_most} exposures")
    return answer, "\n".join(lines)


def _dose_curve(args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions) -> Answer:
    from pans_trainer.evaluate.dose import dose_curve

    with _counted("cap") as report:
        points = dose_curve(bundle, held_out, conditions, report)
    bleaching, objects = conditions.bleaching, len(held_out.objects)
    payload = {"objects": objects, "curve": points, "bleaching": bleaching.spelled() or None}
    if args.pictures is not None:
        from pans_trainer.evaluate.pictures import draw_dose

        payload["pictures"] = [str(draw_dose(args.pictures, {bundle.name: points}, force=args.force))]
    return payload, dose_curve_words(bundle.name, objects, bleaching, points)


def dose_curve_words(name: str, objects: int, bleaching: Bleaching, points: Points) -> str:
    """Return accuracy against dose as a small table."""
    head = f"SIMULATED accuracy of {name} against dose, {objects} objects, {bleaching.words()}"
    return "\n".join([head, *_point_lines(_DOSE_ROWS, points)])


_DOSE_ROWS: tuple[Row, ...] = (
    ("dose cap", "dose_cap", 1.0, ".6g"),
    ("accuracy (%)", "accuracy_mean", 100.0, ".2f"),
    ("  unbleached", "accuracy_unbleached", 100.0, ".2f"),
    ("  spread over trials", "accuracy_std", 100.0, ".2f"),
    ("  error from objects", "accuracy_se_objects", 100.0, ".2f"),
    ("clicks", "clicks_mean", 1.0, ".3f"),
    ("photons", "photons_mean", 1.0, ".2f"),
    ("illumination", "illumination", 1.0, ".1f"),
)


def _point_lines(rows: Iterable[Row], points: Points) -> Iterator[str]:
    """The points of a curve as a small table, one column each; rows that no point has are left out."""
    for label, key, factor, form in rows:
        values = [point[key] for point in points]
        if any(value is not None for value in values):
            cells = ("-" if value is None else format(factor * value, form) for value in values)
            yield f"  {label:21s}" + "".join(f"{cell:>9s}" for cell in cells)


EVALUATE = Command(
    "accuracy of a bundle against photons, sampled or exact",
    _configure,
    _evaluate,
    examples=(
        "pans evaluate parts.pans --exact",
        "pans evaluate parts.pans --profile my-lab.toml --shots 3",
        "pans evaluate parts.pans --dose-cap curve --bleach 40",
    ),
)
