"""The paper's training dynamics: accuracy and illumination against the epoch for several weights alpha, and how patterns change.

Owns the recipe, the walk over d_f and alpha and the two pages (`alpha`, `evolution`); one training with its course is course.py's, the
pictures are in figures_training.py. Every finished training lies in the cache folder, those that `evolution` shows with their patterns.
SIMULATED on the profile `ideal`; FashionMNIST.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.instrument.profile import load_profile
from pans.trainer.options import Options, plain_options
from pans.trainer.paper_tables import PATTERN_PEAKS
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.history import FIRST, TRAINING_OBJECTS, follow

from . import figures_training
from .cache import kept
from .page import Asked
from .passive import PROFILE, TRIALS, measure

TASK = "fashion-mnist"
FEATURES = (10, 16, 24, 32)
ALPHAS = (0.0, 1e-5, 1e-4, 1e-3, 1e-2)
EPOCHS = 16
SHOWN = (10, 1e-4)  # d_f and alpha of the paper's evolution of patterns
STAGES = (1, 3, 8, EPOCHS)  # epochs after which it is shown
LATE = 5  # epochs at the end, over which the growth of the light is told
SETTLED = 3.0  # percent of growth over the last epochs, up to which the light counts as settled


def recipe(features: int, alpha: float) -> Options:
    """Return what a course is trained with: straight-through from first to last and constant rates, as the paper trains."""
    as_the_paper = Options(features, alpha=alpha, estimator="ste", constant=True, hidden=512)
    return replace(as_the_paper, epochs=EPOCHS, batch=512, front_rate=5e-3, head_rate=1e-3)


def course_of(asked: Asked, features: int, alpha: float) -> dict[str, Any] | None:
    """Return one training: `features`, `alpha`, `epochs` (columns of course.EpochFigures) and `final`; None if not made."""
    options = recipe(features, alpha)
    path = asked.cache / f"alpha-{features}-{alpha:g}.json"
    shown = (features, alpha) == SHOWN
    if shown and not path.with_suffix(".npz").is_file():
        path.unlink(missing_ok=True)  # figures without their patterns are half a part

    def make() -> dict[str, Any]:
        task, profile = load_task(TASK, asked.data_dir), load_profile(PROFILE)
        course = follow(task, profile, options, patterns_after=STAGES if shown else ())
        if shown:
            _keep_patterns(path.with_suffix(".npz"), course.patterns)
        final = measure(TASK, task, course.trained)
        return {"features": features, "alpha": alpha, "epochs": course.columns(), "final": final}

    found = kept(path, plain_options(options), make, collect=asked.collect)
    if found is not None:
        final = found["final"]
        asked.report(
            f"d_f = {features}, alpha = {alpha:g}: {final['value']:.2f} % at {final['illumination']:.0f} illumination"
        )
    return found


def _keep_patterns(path: Path, patterns: dict[int, NDArray[np.float32]]) -> None:
    beside = path.with_suffix(".part.npz")
    np.savez_compressed(
        beside, after=np.array(sorted(patterns)), patterns=np.array([patterns[e] for e in sorted(patterns)])
    )
    beside.replace(path)


def alpha_page(asked: Asked) -> dict[str, Any]:
    """Return the page `alpha`: one row per training, one picture per d_f."""
    wanted = [features for features in FEATURES if asked.wants(features)]
    found = [course_of(asked, features, alpha) for features in wanted for alpha in ALPHAS]
    rows = [row for row in found if row is not None]
    pictures = {}
    for features in wanted:
        if mine := [row for row in rows if row["features"] == features]:
            pictures[f"-{features}"] = partial(figures_training.courses, rows=mine)
    return {"rows": rows, "markdown": alpha_markdown(rows), "pictures": pictures}


def growth(row: dict[str, Any]) -> float:
    """Return by how many percent the illumination grew over the last `LATE` epochs."""
    light = row["epochs"]["illumination"]
    return 100 * (float(light[-1]) / float(light[-min(LATE + 1, len(light))]) - 1)


def alpha_markdown(rows: list[dict[str, Any]]) -> str:
    """Return the page `alpha`."""
    options = recipe(FEATURES[0], 0.0)
    lines = [
        "# Training dynamics against the weight of the illumination (alpha)",
        "",
        f"SIMULATED on the profile `{PROFILE}`, FashionMNIST, K = 1. Command: `pans reproduce alpha` (one thread, seed {options.seed}). "
        "The paper's loss: cross-entropy + alpha * sum of squared weights, which is the illumination. Straight-through from first to last, "
        f"constant rates, {options.hidden} hidden units, no budget; the paper trains up to 500 epochs at 1e-3 and 1e-4 with batches "
        f"of 128, we {EPOCHS} epochs at {options.front_rate:g} and {options.head_rate:g} with batches of {options.batch}: a shorter walk "
        "through the same dynamics, whose end is not the end of the paper's.",
        "",
        "![d_f = 10](alpha-10.png)",
        "![d_f = 16](alpha-16.png)",
        "![d_f = 24](alpha-24.png)",
        "![d_f = 32](alpha-32.png)",
        "",
        f"The curves are of the state after each epoch: one draw of clicks of the first {TRAINING_OBJECTS} training objects (which it was "
        "trained on) and of all 10 000 test images; no epoch was chosen by them. The table is of the finished model (whole projector "
        f"levels, head fitted to the last patterns): exact expectation at d_f = 10, {TRIALS} trials above. `trials` is the spread of one "
        f"trial, `objects` the error from having few images, of all 10 000; of the first {FIRST} both are seven "
        f"times as large (2 to 3 points). `grows` is what the illumination changed by over the last {LATE} epochs.",
        "",
        "| d_f | alpha | all 10 000 % | trials | objects | first 200 % | clicks | photons | illumination | grows % "
        "| training % | minutes |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        *(_line(row) for row in rows),
        "",
        *_says(rows),
        "",
    ]
    return "\n".join(lines)


def _line(row: dict[str, Any]) -> str:
    final = row["final"]
    return (
        f"| {row['features']} | {row['alpha']:g} | {final['value']:.2f} | {final['spread_trials']:.2f} | {final['error_objects']:.2f} "
        f"| {final['first_200']:.2f} | {final['clicks']:.2f} | {final['photons']:.1f} | {final['illumination']:.0f} "
        f"| {growth(row):+.1f} | {row['epochs']['training'][-1]:.1f} | {row['cpu_seconds'] / 60:.1f} |"
    )


def _says(rows: list[dict[str, Any]]) -> list[str]:
    """The paper's four regimes beside ours, in numbers."""
    by = {(row["features"], row["alpha"]): row for row in rows}
    done = [d for d in FEATURES if all((d, alpha) in by for alpha in ALPHAS)]
    missing = [str(d) for d in FEATURES if d not in done]
    lines = [f"- Not trained yet, or in part (`pans reproduce alpha`): d_f = {', '.join(missing)}."] if missing else []
    if not done:
        return lines

    def over(values: list[float], digits: int, sign: str = "") -> str:
        least, most = f"{min(values):{sign}.{digits}f}", f"{max(values):{sign}.{digits}f}"
        return least if least == most else f"{least} to {most}"

    def light(alpha: float) -> str:
        return over([by[d, alpha]["final"]["illumination"] for d in done], 0)

    settled = [alpha for alpha in ALPHAS if all(abs(growth(by[d, alpha])) <= SETTLED for d in done)]
    lines += [
        f'- alpha = 0. The paper: the illumination "grows without bound, reaching thousands". Ours: {light(0.0)} after {EPOCHS} epochs, '
        f"{over([growth(by[d, 0.0]) for d in done], 1, '+')} % over the last {LATE}: it does not settle as far as it was followed, and "
        "accuracy gains little by it.",
        f"- The illumination settled (within {SETTLED:g} % over the last {LATE} epochs, at every d_f) at alpha = "
        + (", ".join(f"{alpha:g}" for alpha in settled) or "no value")
        + ". The paper: with weak regularisation it converges to a stable value.",
    ]
    for alpha in ALPHAS[1:]:
        against = [by[d, alpha]["final"]["value"] - by[d, 0.0]["final"]["value"] for d in done]
        lines.append(
            f"- alpha = {alpha:g}: illumination {light(alpha)}; accuracy {over(against, 1, '+')} points against alpha = 0."
        )
    lines += [
        "- The paper prints no numbers of these curves but the range of alpha, 0 to 1e-2, and the four regimes in words; whether ours lie "
        "on its curves cannot be judged from here. It also says that strong regularisation may oscillate: over the last epochs the test "
        f"accuracy of one draw moved within {_range(by, done, ALPHAS[-1])} points at alpha = {ALPHAS[-1]:g}, and within "
        f"{_range(by, done, 0.0)} at alpha = 0.",
    ]
    return lines


def _range(by: dict[tuple[int, float], dict[str, Any]], done: list[int], alpha: float) -> str:
    """How far the held-out accuracy of one draw moved over the last epochs, least and most over d_f."""
    late = [by[d, alpha]["epochs"]["held_out"][-LATE:] for d in done]
    moved = [max(values) - min(values) for values in late]
    return f"{min(moved):.1f} to {max(moved):.1f}" if len(moved) > 1 else f"{moved[0]:.1f}"


# ---- the evolution of patterns ----


def evolution_page(asked: Asked) -> dict[str, Any]:
    """Return the page `evolution`: the patterns of one training at four stages."""
    features, alpha = SHOWN
    row = course_of(asked, features, alpha)
    if row is None:
        return {
            "rows": [],
            "markdown": "# Patterns in the course of a training\n\nNot trained yet: `pans reproduce evolution`.\n",
        }
    with np.load(asked.cache / f"alpha-{features}-{alpha:g}.npz", allow_pickle=False) as kept_patterns:
        patterns = {int(after): shown for after, shown in zip(kept_patterns["after"], kept_patterns["patterns"])}
    normal = {after: shown / shown.mean() for after, shown in patterns.items()}
    rows = [stage_row(row, after, shown) for after, shown in normal.items()]
    picture = partial(figures_training.stages, patterns=normal, peaks=row["epochs"]["peak"])
    return {"rows": rows, "markdown": evolution_markdown(rows, row), "pictures": {"": picture}}


def stage_row(row: dict[str, Any], after: int, normal: NDArray[np.floating]) -> dict[str, Any]:
    """Return one stage: how uneven `normal` (d_f, pixels, mean 1) is, and the course's figures after that epoch."""
    brightest_first = np.sort(normal.ravel())[::-1]
    light = np.cumsum(brightest_first) / brightest_first.sum()
    at = {key: values[after - 1] for key, values in row["epochs"].items()}
    return {
        "epoch": after,
        "peak": float(normal.max()),
        "means": [float(mean) for mean in normal.mean(axis=1)],
        "pixels_with_half_the_light": float((np.searchsorted(light, 0.5) + 1) / light.size),
        "pixels_below_a_tenth_of_the_mean": float((normal < 0.1).mean()),
        **{key: at[key] for key in ("held_out", "held_out_first_200", "clicks", "photons", "illumination")},
    }


def evolution_markdown(rows: list[dict[str, Any]], row: dict[str, Any]) -> str:
    """Return the page `evolution`."""
    features, alpha = SHOWN
    first, last = rows[0], rows[-1]
    final = row["final"]
    said = "the same course, further" if last["peak"] > PATTERN_PEAKS[1] else "the same course, not as far"
    lines = [
        "# Patterns in the course of a training",
        "",
        f"SIMULATED on the profile `{PROFILE}`, FashionMNIST, K = 1, d_f = {features}, alpha = {alpha:g}. Command: "
        f"`pans reproduce evolution` (seed 0, {row['cpu_seconds'] / 60:.1f} processor minutes; the training is that row of "
        "[alpha](alpha.md)). As in the paper all pixels are divided by the mean of all pixels of all patterns, so that this mean is 1; "
        "the number above a pattern is its own mean. The paper does not name the epochs of its stages; ours were fixed beforehand.",
        "",
        "![patterns](evolution.png)",
        "",
        "| after epoch | largest over mean | half of the light in | pixels below a tenth of the mean | means of the patterns "
        "| all 10 000 % | first 200 % | clicks | photons | illumination |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        *(_stage_line(stage) for stage in rows),
        "",
        f"Accuracies are one draw of clicks after that epoch (spread of one trial about {final['spread_trials']:.1f} points, error "
        f"from the objects {final['error_objects']:.1f}, of the first 200 about 3); clicks, photons and illumination are means over the "
        "epoch's batches.",
        "",
        f"- The paper: the largest value rises from about {PATTERN_PEAKS[0]} to about {PATTERN_PEAKS[1]} times the mean. Ours: from "
        f"{first['peak']:.0f} after epoch {first['epoch']} to {last['peak']:.0f} after epoch {last['epoch']}: {said}. Uniform random "
        "weights, squared, begin at 3.",
        "- The paper: intensity concentrates while most of the image becomes dark. Ours: half of the light lies in "
        f"{100 * first['pixels_with_half_the_light']:.1f} % of the pixels at first, in {100 * last['pixels_with_half_the_light']:.1f} % at "
        f"last; pixels below a tenth of the mean are {100 * first['pixels_below_a_tenth_of_the_mean']:.0f} and "
        f"{100 * last['pixels_below_a_tenth_of_the_mean']:.0f} %.",
        "",
    ]
    return "\n".join(lines)


def _stage_line(stage: dict[str, Any]) -> str:
    return (
        f"| {stage['epoch']} | {stage['peak']:.0f} | {100 * stage['pixels_with_half_the_light']:.1f} % of the pixels "
        f"| {100 * stage['pixels_below_a_tenth_of_the_mean']:.0f} % | {min(stage['means']):.2f} to {max(stage['means']):.2f} "
        f"| {stage['held_out']:.2f} | {stage['held_out_first_200']:.1f} | {stage['clicks']:.2f} | {stage['photons']:.1f} "
        f"| {stage['illumination']:.0f} |"
    )
