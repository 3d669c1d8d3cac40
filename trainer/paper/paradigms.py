"""The paper's comparison of paradigms: accuracy against photons, PANS beside the baselines (its Fig. 2E and the green curve's appendix).

Owns the pages `fig-2e` and `end-to-end`; the baselines are baseline_curves.py's, PANS' rows those of `pans reproduce fashion-mnist` in the
same cache folder. SIMULATED; FashionMNIST.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from pans.trainer.paper_tables import ACTIVE, E2E_FEW, E2E_MANY, PANS_FEW, SHOTS, ActiveRow

from . import figures_baselines
from .active import finished_row
from .baseline_curves import (
    CLEAN,
    CURVES,
    E2E_FEATURES,
    ENVELOPE,
    LEVELS,
    POSTERIOR,
    TASK,
    Curve,
    Rows,
    accuracy_at,
    curve_rows,
    e2e_curve,
    envelope,
)
from .page import Asked

PANS = "PANS"
KEPT = (
    "accuracy_mean",
    "accuracy_std",
    "accuracy_se_objects",
    "clicks_mean",
    "photons_mean",
    "illumination",
    "objects",
    "trials",
)
HEAD = "| way | d_f | photons asked | all 10 000 % | trials | objects | first 200 % | objects | clicks | photons | illumination |"


def fig_2e_page(asked: Asked) -> dict[str, Any]:
    """Return the page `fig-2e`."""
    curves = {curve.way: curve_rows(asked, curve) for curve in CURVES}
    curves[ENVELOPE] = envelope(_end_to_end(asked))
    pans = []
    for row in ACTIVE[TASK]:
        figures = finished_row(asked.cache, TASK, row)
        if figures is None:
            asked.report(f"{PANS} d_f = {row.features}: not trained yet (pans reproduce {TASK} --rows {row.features})")
        else:
            pans.append((row, figures))
    rows = [_plain(row) for way in curves.values() for row in way] + [_plain(_pans_row(*each)) for each in pans]
    drawn = partial(figures_baselines.paradigms, rows=rows, paper=ACTIVE[TASK])
    return {"rows": rows, "markdown": fig_2e_markdown(rows), "pictures": {"": drawn}}


def end_to_end_page(asked: Asked) -> dict[str, Any]:
    """Return the page `end-to-end`."""
    measured = _end_to_end(asked)
    rows = [_plain(row) for row in measured + envelope(measured)]
    drawn = partial(figures_baselines.end_to_end, rows=rows)
    return {"rows": rows, "markdown": end_to_end_markdown(rows), "pictures": {"": drawn}}


def _end_to_end(asked: Asked) -> Rows:
    return [row for features in E2E_FEATURES if asked.wants(features) for row in curve_rows(asked, e2e_curve(features))]


def _pans_row(row: ActiveRow, figures: dict[str, Any]) -> dict[str, Any]:
    one = str(SHOTS[0])
    return figures["all"][one] | {
        "way": PANS,
        "features": row.features,
        "first_200": figures["first_200"][one],
        "cpu_seconds": figures["cpu_seconds"],
    }


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """Return what the page keeps of a row."""
    facts = {key: row[key] for key in ("way", "features", "photons_asked", "cpu_seconds", "seconds") if key in row}
    return facts | {key: row[key] for key in KEPT} | {"first_200": {key: row["first_200"][key] for key in KEPT}}


def table_lines(rows: Rows) -> list[str]:
    """Return every row with its light and both spreads."""
    lines = [HEAD, "| --- " * 11 + "|"]
    for row in rows:
        first = row["first_200"]
        spread = f"{100 * row['accuracy_std']:.2f}" + ("" if row["trials"] else " (exact)")
        asked_for = f"{row['photons_asked']:g}" if "photons_asked" in row else "-"
        lines.append(
            f"| {row['way']} | {row['features']} | {asked_for} | {100 * row['accuracy_mean']:.2f} | {spread} "
            f"| {100 * row['accuracy_se_objects']:.2f} | {100 * first['accuracy_mean']:.2f} | {100 * first['accuracy_se_objects']:.1f} "
            f"| {row['clicks_mean']:.2f} | {row['photons_mean']:.1f} | {row['illumination']:.0f} |"
        )
    return lines


def matrix_lines(rows: Rows, ways: list[str]) -> list[str]:
    """Return accuracies of all test objects, one line per way and one column per photon level."""
    by = {(row["way"], row.get("photons_asked")): f"{100 * row['accuracy_mean']:.1f}" for row in rows}
    levels = [level for level in LEVELS if any((way, level) in by for way in ways)]
    lines = [f"| way | {' | '.join(f'{level:g}' for level in levels)} |", "| --- " * (len(levels) + 1) + "|"]
    return lines + [f"| {way} | {' | '.join(by.get((way, level), '') for level in levels)} |" for way in ways]


# ---- fig-2e ----


def fig_2e_markdown(rows: Rows) -> str:
    """Return the page `fig-2e`."""
    ways = [curve.way for curve in CURVES] + [ENVELOPE]
    missing = [f"{curve.way} (`{curve.command()}`)" for curve in CURVES if not _of(rows, curve.way)]
    trained = [row["features"] for row in rows if row["way"] == PANS]
    untrained = [str(row.features) for row in ACTIVE[TASK] if row.features not in trained]
    if untrained:
        missing.append(f"{PANS} d_f = {', '.join(untrained)} (`pans reproduce {TASK}`)")
    lines = [
        "# Accuracy against photons: PANS and the alternatives (paper, Fig. 2E)",
        "",
        "SIMULATED, FashionMNIST, K = 1, seed 0, ideal shot noise, no dark counts. Command: `pans reproduce fig-2e`; the rows "
        "of PANS are "
        f"those of `pans reproduce {TASK}` in the same cache folder (profile `ideal`, thresholded detectors: a click at most "
        "each). **The "
        "baselines count photons**: their detectors are perfect counters, which is more than PANS is given. All ways are trained on the "
        "60 000 training objects and judged on all 10 000 test images; the first 200 are the paper's.",
        "",
        "![accuracy](fig-2e.png)",
        "",
        "Left, as the paper draws it: PANS over its **clicks** (first 200 images), the baselines over their photons. Middle: "
        "everything over "
        "the **photons detected**. Right: over the **illumination**, all light that is thrown at the object.",
        "",
        *([f"Not finished yet: {'; '.join(missing)}.", ""] if missing else []),
        *_fig_2e_says(rows),
        "",
        "## All 10 000 test images, accuracy % over photons",
        "",
        *matrix_lines(rows, [way for way in ways if _of(rows, way)]),
        "",
        "## Everything",
        "",
        "`trials` is the spread of one trial, `objects` the error from having few images (of all, then of the first 200). "
        "`clicks` are readouts with at least one "
        "photon; `photons` are detected photoelectrons, mean over the test images.",
        "",
        *table_lines(rows),
        "",
        "## Commands of the curves",
        "",
        *(f"- {curve.way}: `{curve.command()}`" for curve in CURVES),
        f"- {ENVELOPE}: the best of the nine of [end-to-end](end-to-end.md) at each level, chosen by these test images as the paper's is",
        "",
    ]
    return "\n".join(lines)


def _of(rows: Rows, way: str) -> Rows:
    return [row for row in rows if row["way"] == way]


def _fig_2e_says(rows: Rows) -> list[str]:
    pans, best = _of(rows, PANS), _of(rows, ENVELOPE)
    clean, posterior = (_of(rows, curve.way) for curve in (CLEAN, POSTERIOR))
    lines = []
    for name, of in (("photons", lambda row: row["photons_mean"]), ("illumination", lambda row: row["illumination"])):
        for other, words in (
            (posterior, "direct imaging decided by the exact posterior"),
            (best, "the end-to-end envelope"),
        ):
            pairs = [(row, accuracy_at(other, of(row), of)) for row in pans]
            known = [(row, there) for row, there in pairs if there is not None]
            if not known:
                continue
            ahead = [_compared(row, there, of(row)) for row, there in known if row["accuracy_mean"] > there]
            behind = [_compared(row, there, of(row)) for row, there in known if row["accuracy_mean"] <= there]
            lines.append(
                f"- **At equal {name}**, all test images, PANS is ahead of {words} at d_f = {', '.join(ahead) or 'none'}"
                + (f"; behind at d_f = {', '.join(behind)}" if behind else "")
                + " (d_f: ours against theirs, at so much)."
            )
    if clean and posterior:
        both = [(a, b) for a, b in _same_level(clean, posterior) if a["photons_asked"] in (17.0, 100.0)]
        told = [
            f"{100 * a['accuracy_mean']:.1f} against {100 * b['accuracy_mean']:.1f} % at {a['photons_asked']:g} photons"
            for a, b in both
        ]
        lines.append(
            "- The paper's blue curve is a network trained on clean frames. The exact posterior decides the same frames: "
            f"{'; '.join(told)}. The gap in the paper's figure is mostly that network's."
        )
    levels = [(a["photons_asked"], a["accuracy_mean"] > b["accuracy_mean"]) for a, b in _same_level(best, posterior)]
    if levels:
        above = [f"{photons:g}" for photons, ahead in levels if ahead]
        lines.append(
            '- The paper: conventional end-to-end "substantially outperforms both direct imaging and compressive sensing". Ours is above '
            f"direct imaging by the exact posterior at {', '.join(above) or 'none'} of the {len(levels)} levels up to "
            f"{levels[-1][0]:g} photons."
        )
    if pans:
        lines.append(
            "- The rows of PANS are held to the paper's clicks, not to photons, and spend these freely. What patterns do with less light "
            "is in [fig-2c](fig-2c.md), what a budget of photons does, on other tasks, in [equal-photons](equal-photons.md)."
        )
    return lines + _claims(rows)


def _same_level(some: Rows, others: Rows) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    return [(a, b) for a in some for b in others if a["photons_asked"] == b["photons_asked"]]


def _compared(row: dict[str, Any], there: float, place: float) -> str:
    return f"{row['features']} ({100 * row['accuracy_mean']:.1f} against {100 * there:.1f} % at {place:.0f})"


def _claims(rows: Rows) -> list[str]:
    """The paper's sentences about the end-to-end baseline, with ours."""
    best = {row["photons_asked"]: 100 * row["accuracy_mean"] for row in _of(rows, ENVELOPE)}
    if not best:
        return []
    (few, few_low, few_high), (many, many_value) = E2E_FEW, E2E_MANY
    few_patterns = next(row["features"] for row in _of(rows, ENVELOPE) if row["photons_asked"] == few)
    lines = [
        f"- The paper: conventional end-to-end reaches only {few_low:g} to {few_high:g} % at about {few:g} photons. Ours: "
        f"{best[few]:.1f} % (d_f = {few_patterns})"
        + (
            ", the same."
            if few_low <= best[few] <= few_high
            else ", which is more: few patterns do better there than many."
            if best[few] > few_high
            else ", which is less."
        )
        + f" The paper: about {many_value:g} % from {many:g} photons. Ours: {best[many]:.1f} % there."
    ]
    row = next((row for row in _of(rows, PANS) if row["features"] == 10), None)
    if row is not None:
        one = row["first_200"]
        lines.append(
            f'- The paper sets about {PANS_FEW[1]:g} % of PANS at about {PANS_FEW[0]:g} "photons" against that. These are '
            f"clicks: our ten patterns have {one['clicks_mean']:.2f} clicks ({100 * one['accuracy_mean']:.1f} % of the first "
            "200) and detect "
            f"{one['photons_mean']:.0f} photons for them; the envelope has {best[30.0]:.1f} % at 30 photons."
        )
    return lines


# ---- end-to-end ----


def end_to_end_markdown(rows: Rows) -> str:
    """Return the page `end-to-end`."""
    curves = [e2e_curve(features) for features in E2E_FEATURES]
    done = [curve for curve in curves if _of(rows, curve.way)]
    missing: list[Curve] = [curve for curve in curves if curve not in done]
    top = {row["photons_asked"]: row["features"] for row in _of(rows, ENVELOPE)}
    lines = [
        "# Conventional end-to-end optimisation, without photons in training",
        "",
        "SIMULATED, FashionMNIST, perfect photon counters, seed 0, all 10 000 test images. Command: `pans reproduce "
        "end-to-end`. Patterns and "
        "head (512 hidden units, as in PANS) are trained on expected values with quantisation-aware training (4 bits of a value, 5 of a "
        "pattern: the paper names the technique and no numbers), 15 epochs each; then all light is scaled to the photons of the column.",
        "",
        "![accuracy](end-to-end.png)",
        "",
        *([f"Not finished yet: {'; '.join(f'`{curve.command()}`' for curve in missing)}.", ""] if missing else []),
        *matrix_lines(rows, [curve.way for curve in done] + ([ENVELOPE] if top else [])),
        "",
        f"The envelope is of d_f = {', '.join(f'{d} (at {n:g})' for n, d in top.items())}; it is chosen by the test images, "
        "as the paper's is."
        if top
        else "",
        *_claims(rows),
        "- More patterns share the light: at few photons few patterns are better, at many photons many.",
        "",
        "## Everything",
        "",
        "`trials` is the spread of one trial, `objects` the error from having few images (of all, then of the first 200).",
        "",
        *table_lines([row for row in rows if row["way"] != ENVELOPE]),
        "",
        "## Commands of the curves",
        "",
        *(f"- d_f = {features}: `{curve.command()}`" for features, curve in zip(E2E_FEATURES, curves)),
        "",
    ]
    return "\n".join(lines)
