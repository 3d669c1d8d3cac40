"""The paper's sweeps of light and dark counts over all FashionMNIST rows (appendix on testing): `eta` and `dark-counts`.

Owns the two pages and what they say of the paper's claims; a setting is measured by reproduce_sweeps.py, the rows are those of the
table. SIMULATED; K = 1, nothing is trained.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from pans.runtime.instrument.profile import load_profile
from pans.trainer.paper_tables import FIRST_OBJECTS
from pans.trainer.tasks.registry import load_task

from . import figures_rows
from .active import PROFILE
from .page import Asked
from .sweeps import DARKS, ETAS, EXACT_WORK_MAX, TRIALS, TRIALS_OF_ALL, measure_setting
from .trained_rows import (
    SPREADS_SAY,
    TrainedRow,
    measured_on,
    profile_says,
    rows_say,
    seconds_say,
    table_head,
    trained_rows,
)

TABLE = "fashion-mnist"
FIRST = f"first_{FIRST_OBJECTS}"
NEAR = 2.0  # a peak within this factor of 1 is `near` it
LEVEL = 2.0  # points below the best that still count as level with it

Rows = list[dict[str, Any]]
Curves = dict[int, Rows]  # by d_f, one row per setting, in rising order


def eta_page(asked: Asked) -> dict[str, Any]:
    """Return one row per d_f and factor of the light, and the page."""
    curves, said = _swept(asked, "eta", ETAS)
    lines = [
        "# Accuracy against the light, times the trained light (eta)",
        "",
        *_head(asked.name, "All light times eta, K = 1. The head stays as it was trained, at eta = 1."),
        "",
        "![accuracy over the light, one curve per number of patterns](eta.png)",
        "",
        *said,
        "",
        "The paper (appendix, *photon level scaling*; a plot without numbers, first 200 images, 100 trials) says: *all models achieve peak "
        "accuracy near eta = 1 and degrade for both lower and higher eta values*; at very low eta all converge to guessing.",
        "",
        *_trained_light(curves),
        *_eta_says(curves),
        *_over_settings("eta", curves),
        "Photons and illumination are eta times those at eta = 1.",
        "",
    ]
    return _page(lines, curves, "eta")


def dark_page(asked: Asked) -> dict[str, Any]:
    """Return one row per d_f and dark count, and the page."""
    curves, said = _swept(asked, "dark", DARKS)
    lines = [
        "# Accuracy against dark counts",
        "",
        *_head(asked.name, "Expected dark counts of a detector and exposure, K = 1, with heads that were not told."),
        "",
        "![accuracy over dark counts, one curve per number of patterns](dark-counts.png)",
        "",
        *said,
        "",
        "The paper (appendix, *dark count rate*; a plot without numbers, first 200 images, 100 trials) says: *accuracy degrades gradually "
        "up to DCR ~ 0.1 and more rapidly at higher values*. It adds a Poisson number to the detection outcome; here a dark count and a "
        "photon in one exposure are one click.",
        "",
        *_trained_light(curves),
        *_dark_says(curves),
        *_over_settings("dark", curves),
        "Photons and illumination stay as they are at any dark count.",
        "",
    ]
    return _page(lines, curves, "dark")


def _page(lines: list[str], curves: Curves, sweep: str) -> dict[str, Any]:
    rows = [row for curve in curves.values() for row in curve]
    pictures = {"": partial(figures_rows.robustness, rows=rows, sweep=sweep)}
    return {"rows": rows, "markdown": "\n".join(lines), "pictures": pictures}


def _head(name: str, what: str) -> list[str]:
    words = EXACT_WORK_MAX.bit_length() - 1
    return [
        f"{profile_says()} Command: `pans reproduce {name}`; nothing is trained, seed 1 of the trials. {what} Exact expectations over "
        f"all click words where these times the images are at most 2^{words} (d_f up to 16 on the first {FIRST_OBJECTS}, up to 10 on all), "
        f"else {TRIALS[FIRST_OBJECTS]} trials of the first {FIRST_OBJECTS}, {TRIALS_OF_ALL} of all. {SPREADS_SAY}"
    ]


def _swept(asked: Asked, sweep: str, settings: tuple[float, ...]) -> tuple[Curves, list[str]]:
    """Measure every trained row at every setting; finished rows lie in the cache. Also what to say of the rows."""
    curves: Curves = {}
    parts = []
    trained = trained_rows(asked, TABLE)
    for row in trained:
        facts = {"settings": settings, "trials": [TRIALS[FIRST_OBJECTS], TRIALS_OF_ALL], "exact": EXACT_WORK_MAX}
        measure = partial(_all_settings, row, asked.data_dir, sweep, settings)
        made = measured_on(asked, row, facts, measure)
        if made is None:
            asked.report(f"{asked.name}: d_f = {row.features} is not measured yet: pans reproduce {asked.name}")
            continue
        parts.append(made)
        of_row = {"table": TABLE, "features": row.features}
        base = {"sweep": sweep, "setting": "trained", FIRST: row.figures[FIRST]["1"], "all": row.figures["all"]["1"]}
        curves[row.features] = [of_row | base, *(of_row | found for found in made["rows"])]
    return curves, [*rows_say(TABLE, [row for row in trained if row.features in curves]), seconds_say(parts)]


def _all_settings(row: TrainedRow, data_dir: str | None, sweep: str, settings: tuple[float, ...]) -> dict[str, Any]:
    test, profile = load_task(TABLE, data_dir).test, load_profile(PROFILE)
    return {"rows": [measure_setting(row.bundle, profile, test, sweep, setting) for setting in settings]}


# ---- what stands on the pages ----


def _percent(row: dict[str, Any], part: str = "all") -> float:
    return 100 * float(row[part]["accuracy_mean"])


def _at(curve: Rows, setting: float) -> dict[str, Any]:
    """The row of a setting, up to rounding."""
    return min(curve[1:], key=lambda row: abs(float(row["setting"]) - setting))


def _trained_light(curves: Curves) -> list[str]:
    """As trained, without dark counts: the operating point with all its figures."""
    lines = table_head(
        "d_f",
        f"first {FIRST_OBJECTS}",
        "trials",
        "objects",
        "all",
        "trials",
        "objects",
        "clicks",
        "photons",
        "illumination",
    )
    for features, (trained, *_) in curves.items():
        cells = [str(features)]
        for part in (FIRST, "all"):
            cells += [
                f"{100 * trained[part][key]:.2f}" for key in ("accuracy_mean", "accuracy_std", "accuracy_se_objects")
            ]
        whole = trained["all"]
        cells += [f"{whole['clicks_mean']:.2f}", f"{whole['photons_mean']:.1f}", f"{whole['illumination']:.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return ["As trained (eta = 1, no dark counts):", "", *lines, ""]


def _over_settings(sweep: str, curves: Curves) -> list[str]:
    """Accuracy and clicks, settings down, d_f across."""
    if not curves:
        return []
    settings = [row["setting"] for row in next(iter(curves.values()))[1:]]
    widest = {
        part: max(row[part]["accuracy_std"] for curve in curves.values() for row in curve) for part in (FIRST, "all")
    }
    heads = [f"d_f = {features}" for features in curves]
    lines = [
        f"Accuracy in %, first {FIRST_OBJECTS} / all (spread of one trial at most {100 * widest[FIRST]:.1f} / {100 * widest['all']:.2f} "
        "points; each in the JSON):",
        "",
        *table_head(sweep, *heads),
    ]
    for i, setting in enumerate(settings, 1):
        cells = [f"{_percent(curve[i], FIRST):.1f} / {_percent(curve[i]):.1f}" for curve in curves.values()]
        lines.append(f"| {setting:.3g} | {' | '.join(cells)} |")
    lines += ["", "Clicks of a decision, all images:", "", *table_head(sweep, *heads)]
    for i, setting in enumerate(settings, 1):
        cells = [f"{curve[i]['all']['clicks_mean']:.2f}" for curve in curves.values()]
        lines.append(f"| {setting:.3g} | {' | '.join(cells)} |")
    return [*lines, ""]


def _eta_says(curves: Curves) -> list[str]:
    best = (
        "best eta (all)",
        "gain over eta = 1",
        f"best eta (first {FIRST_OBJECTS})",
        "gain",
        f"within {LEVEL:g} points of the best",
    )
    lines = table_head("d_f", *best, "change at 0.1", "at 0.32", "at 3.2", "at 10", "accuracy at 0.01", "at 100")
    far, rising = [], []
    for features, curve in curves.items():
        one, cells = _at(curve, 1.0), [str(features)]
        for part in ("all", FIRST):
            top_row = max(curve[1:], key=partial(_percent, part=part))
            cells += [f"{top_row['setting']:.2f}", f"{_percent(top_row, part) - _percent(one, part):+.2f}"]
            if part == "all" and not 1 / NEAR <= top_row["setting"] <= NEAR:
                far.append(f"d_f = {features} ({top_row['setting']:.2g})")
        top = max(map(_percent, curve[1:]))
        level = [row["setting"] for row in curve[1:] if _percent(row) >= top - LEVEL]
        cells.append(f"{min(level):.2g} to {max(level):.2g}")
        changes = [_percent(_at(curve, eta)) - _percent(one) for eta in (0.1, 10**-0.5, 10**0.5, 10.0)]
        cells += [f"{change:+.1f}" for change in changes] + [
            f"{_percent(_at(curve, eta)):.1f}" for eta in (0.01, 100.0)
        ]
        rising += [str(features)] if changes[2] > 0 else []
        lines.append(f"| {' | '.join(cells)} |")
    if not curves:
        return []
    dim = [_percent(_at(curve, 0.01)) for curve in curves.values()]
    return [
        *lines,
        "",
        f"- Peak near eta = 1 (within a factor of {NEAR:g}): {len(curves) - len(far)} of {len(curves)} rows"
        + (f"; **not at {', '.join(far)}**." if far else "."),
        f"- A third of the light costs accuracy in {_worse(curves, 10**-0.5)} of {len(curves)} rows, ten times the light in "
        f"{_worse(curves, 10.0)}."
        + (f" At 3.2 times the light d_f = {', '.join(rising)} still gain." if rising else ""),
        "- *Accuracy degrades gracefully over a substantial range* below 1: ours lose "
        + ", ".join(f"{_loss(curves, 10**step)} points at {10**step:.2g}" for step in (-0.25, -0.5, -1.0))
        + f". More light costs less: {_loss(curves, 10**0.5)} points at 3.2, {_loss(curves, 10.0)} at 10, {_loss(curves, 100.0)} at 100.",
        f"- At eta = 0.01 the rows decide {min(dim):.1f} to {max(dim):.1f} % right (guessing: 10 %).",
        "",
    ]


def _loss(curves: Curves, eta: float) -> str:
    lost = [_percent(_at(curve, 1.0)) - _percent(_at(curve, eta)) for curve in curves.values()]
    return f"{min(lost):.1f} to {max(lost):.1f}"


def _worse(curves: Curves, eta: float) -> int:
    """Rows that decide worse at `eta` than at the trained light."""
    return sum(_percent(_at(curve, eta)) < _percent(_at(curve, 1.0)) for curve in curves.values())


def _dark_says(curves: Curves) -> list[str]:
    levels = (0.01, 10**-1.5, 0.1, 10**-0.5, 1.0)
    lines = table_head(
        "d_f", *(f"change at {level:.2g}" for level in levels), "points per decade, 0.01 to 0.1", "0.1 to 1"
    )
    steeper, lost = [], {}
    for features, curve in curves.items():
        trained = _percent(curve[0])
        changes = [_percent(_at(curve, level)) - trained for level in levels]
        low, high = changes[2] - changes[0], changes[4] - changes[2]
        steeper += [features] if high < low else []
        lost[features] = -changes[2]
        lines.append(f"| {features} | {' | '.join(f'{change:+.1f}' for change in (*changes, low, high))} |")
    if not curves:
        return []
    most, least = max(lost, key=lost.__getitem__), min(lost, key=lost.__getitem__)
    return [
        "Change of the accuracy in points (all images) against no dark counts:",
        "",
        *lines,
        "",
        f"- *More rapidly* above 0.1 than below (points per decade): {len(steeper)} of {len(curves)} rows.",
        f"- *Maintains strong performance up to approximately 0.1*: at 0.1 ours lose {lost[least]:.1f} (d_f = {least}) to {lost[most]:.1f} "
        f"points (d_f = {most}); at 0.01 it is {-_least(curves, 0.01, max):.1f} to {-_least(curves, 0.01, min):.1f}.",
        "",
    ]


def _least(curves: Curves, level: float, choose: Any) -> float:
    return float(choose(_percent(_at(curve, level)) - _percent(curve[0]) for curve in curves.values()))
