"""The paper's accuracy over patterns and shots: Fig. 3 B and C (one shot), and more patterns against more shots (appendix on testing).

Owns the pages `fig-3` and `multi-shot` and the comparison where both spend the same; the figures are those of the active tables, nothing
is measured here. SIMULATED.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pans.trainer.verdicts import VERDICTS, Claim, against, claim, sampling_error, verdict

from . import plots
from .active import TrainedRow, by_table, trained_rows
from .page import Asked, Column, Made, Row, Rows, Table, at, columns, pages
from .tables import ACTIVE, FIRST, FIRST_OBJECTS, SHOTS

Point = tuple[float, float, float]  # what was spent, accuracy in %, its standard error from having few objects
Curves = dict[int, list[Point]]  # by d_f, one point per number of shots


def multi_shot_page(asked: Asked) -> Made:
    """Return one row per table, d_f and number of shots."""
    rows = [_point(row, shots) for table in ACTIVE for row in trained_rows(asked, table) for shots in SHOTS]
    return Made(rows, {"": partial(plots.multi_shot, rows=rows)})


def fig_3_page(asked: Asked) -> Made:
    """Return one row per table and d_f at one shot."""
    rows = [_point(row, 1) for table in ACTIVE for row in trained_rows(asked, table)]
    return Made(rows, {"": partial(plots.fig_3, rows=rows)})


def _point(row: TrainedRow, shots: int) -> Row:
    i = SHOTS.index(shots)
    kinds = ("simulation", "simulation_std", "experiment", "experiment_std")
    return {
        "table": row.table,
        "features": row.features,
        "shots": shots,
        "detections": row.features * shots,
        FIRST: row.figures[FIRST][str(shots)],
        "all": row.figures["all"][str(shots)],
        "paper": {kind: getattr(row.paper, kind)[i] for kind in kinds} | {"clicks": shots * row.paper.clicks},
        "sha256": row.sha256,
    }


def fig_3_tables(rows: Rows) -> list[Table]:
    """Return one table per data set."""
    return [_beside_paper("fig_3", table, mine, ("simulation", "experiment")) for table, mine in by_table(rows)]


def _beside_paper(shown: str, table: str, mine: Rows, kinds: Sequence[str]) -> Table:
    """A table of ours on the paper's images beside its figures; with the spread of trainings the page of the table itself judges."""
    whole = [row | {"beside": {kind: _held_against(row, kind) for kind in kinds}} for row in mine]
    claims = [claim("Ours", f"the paper's {kind}", [row["beside"][kind] for row in whole]) for kind in kinds]
    return Table(columns(shown), whole, f"## {table}", claims)


def _held_against(row: Row, kind: str) -> Row:
    ours, theirs = row[FIRST], row["paper"][kind]
    errors = (100 * ours["accuracy_se_objects"], sampling_error(theirs, FIRST_OBJECTS))
    return against(100 * ours["accuracy_mean"], theirs, *errors)


def multi_shot_tables(rows: Rows) -> list[Table]:
    """Return per data set every point, and the comparison of more patterns with more shots where they spend the same."""
    found = []
    for table, mine in by_table(rows):
        ordered = sorted(mine, key=lambda row: (row["detections"], row["features"]))
        found += [_beside_paper("multi_shot", table, ordered, ("simulation",)), _duels_table(table, mine)]
    return found


class Duel(NamedTuple):
    """`few` patterns with `shots` shots against `many` that spend the same; `ahead`: points of `many` over `few`, `error` of both."""

    few: int
    shots: int
    many: int
    spent: float
    ahead: float
    error: float
    exact: bool  # `many` was measured at that very point, not between two


def duels(curves: Curves) -> list[Duel]:
    """Hold every point of several shots against the curves of more patterns where they reach as far (linear in log of what is spent)."""
    found = []
    for few, many in combinations(sorted(curves), 2):
        reach, values, errors = zip(*curves[many])
        for shots, (spent, value, error) in zip(SHOTS, curves[few]):
            if min(reach) <= spent <= max(reach):
                there, error_there = (float(np.interp(np.log(spent), np.log(reach), y)) for y in (values, errors))
                both = math.hypot(error, error_there)
                found.append(Duel(few, shots, many, spent, there - value, both, spent in reach))
    return found


def _duels_table(table: str, mine: Rows) -> Table:
    """In how many comparisons more patterns are above, level and below, and their least lead in points; bold where one is below."""
    first, ours, clicks, photons = f"ours, first {FIRST_OBJECTS}", "ours, all", "all.clicks_mean", "all.photons_mean"
    sets = (
        ("paper, simulation", "detections", "detections", "paper.simulation", 1),
        (first, "detections", "detections", f"{FIRST}.accuracy_mean", 100),
        (ours, "detections", "detections", "all.accuracy_mean", 100),
        ("paper, simulation", "clicks", "paper.clicks", "paper.simulation", 1),
        (ours, "clicks", clicks, "all.accuracy_mean", 100),
        (ours, "photons", photons, "all.accuracy_mean", 100),
    )
    few = sorted({row["features"] for row in mine})[:-1]
    rows, claims = [], []
    for whose, words, spent, value, scale in sets:
        curves: Curves = {}
        for row in mine:
            accuracy = scale * at(row, value)
            kept = at(row, f"{value.partition('.')[0]}.accuracy_se_objects")
            error = sampling_error(accuracy, FIRST_OBJECTS) if kept is None else scale * kept
            curves.setdefault(row["features"], []).append((at(row, spent), accuracy, error))
        found = duels(curves)
        verdicts = tuple(verdict(duel.ahead, duel.error) for duel in found)
        claims.append(Claim("More patterns", f"more shots at equal {words} ({whose})", verdicts))
        won = {str(d): _won([duel for duel in found if duel.few == d]) for d in few}
        rows.append({"whose": whose, "at equal": words, **won, "together": _won(found)})
    heads = ("whose", "at equal", *map(str, few), "together")
    shown = [Column(head, f"{{{head}}}") for head in heads]
    heading = f"### {table}: all larger d_f against d_f (columns) with more shots: above / level / below (least lead)"
    return Table(shown, rows, heading, claims)


def _won(found: Sequence[Duel]) -> str | None:
    if not found:
        return None
    verdicts = [verdict(duel.ahead, duel.error) for duel in found]
    counts = [verdicts.count(one) for one in VERDICTS]
    words = f"{' / '.join(map(str, counts))} ({min(duel.ahead for duel in found):+.1f})"
    return f"**{words}**" if counts[-1] else words


PAGES = pages({"fig-3": (fig_3_page, fig_3_tables), "multi-shot": (multi_shot_page, multi_shot_tables)})
