"""What the rows of the frontier say: means over seeds, how far a way is ahead of direct imaging, and the paper's click budgets.

Owns the arithmetic; made of rows alone, never measures.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from itertools import pairwise

from pans.trainer.paper.page import Row, Rows, at
from pans.trainer.paper.tables import ACTIVE, FIRST

from .fixed import PAPER
from .ways import AUTOMATA, DIRECT, LONGER, STOPPING, TASKS, TRAINED

SUMMED = ("accuracy_mean", "accuracy_se_objects", "clicks_mean", "photons_mean", "illumination")


def by_point(rows: Rows) -> Rows:
    """Return one row per task, way and level: means over its seeds, `se_seeds` of the accuracy (None of one seed), `seeds`."""
    groups: dict[tuple[str, str, float], Rows] = {}
    for row in rows:
        if "all" in row or FIRST in row:
            groups.setdefault((row["task"], row["way"], row["level"]), []).append(row)
    return [_mean(found) for found in groups.values()]


def _mean(found: Rows) -> Row:
    first = found[0]
    whole: Row = {key: first[key] for key in ("task", "way", "level", "bound") if key in first}
    whole |= {"seeds": len(found), "exposures": statistics.fmean(row["exposures"] for row in found)}
    for part in ("all", FIRST):
        rows = [row[part] for row in found if part in row]
        if rows:
            means = {key: statistics.fmean(row[key] for row in rows) for key in SUMMED if key in rows[0]}
            accuracies = [row["accuracy_mean"] for row in rows]
            spread = statistics.stdev(accuracies) / math.sqrt(len(rows)) if len(rows) > 1 else None
            whole[part] = means | {"se_seeds": spread, "objects": rows[0].get("objects")}
    return whole


def error_of(row: Row) -> float:
    """Return the standard error of a point's accuracy on all images: from its seeds, where there are several, and from its objects."""
    return math.hypot(row["all"]["se_seeds"] or 0.0, row["all"].get("accuracy_se_objects", 0.0))


def margins(points: Rows) -> Rows:
    """Return all points of other ways within the levels of exact direct imaging, with `beside`, `ahead` and `error` at their own photons.

    Where direct imaging that stops when it is sure can take as many photons, `sure` has its accuracy, and the same two against it.
    Between neighbouring levels it is interpolated in the logarithm of the photons. Both errors count, as if the images were
    drawn for each: they are the same, so the true error is smaller.
    """
    found = []
    for point in points:
        if point["way"] in (DIRECT, STOPPING) or "all" not in point:
            continue
        of_task = [row for row in points if row["task"] == point["task"]]
        beside, sure = (
            _ahead(point, direct_at(of_task, point["all"]["photons_mean"], way)) for way in (DIRECT, STOPPING)
        )
        if beside is not None:
            found.append(point | beside | ({} if sure is None else {"sure": sure}))
    return found


def _ahead(point: Row, beside: Row | None) -> Row | None:
    if beside is None:
        return None
    ahead = point["all"]["accuracy_mean"] - beside["accuracy_mean"]
    return {"beside": beside, "ahead": ahead, "error": math.hypot(error_of(point), beside["error"])}


def direct_at(points: Iterable[Row], photons: float, way: str = DIRECT) -> Row | None:
    """Return accuracy and error of a way of direct imaging at that many photons, None beyond its levels."""
    curve = sorted((row for row in points if row["way"] == way), key=lambda row: float(row["all"]["photons_mean"]))
    for low, high in pairwise(curve):
        x0, x1 = (math.log(row["all"]["photons_mean"]) for row in (low, high))
        if x0 - 1e-6 <= math.log(photons) <= x1 + 1e-6:
            share = (math.log(photons) - x0) / (x1 - x0)
            parts = [(1 - share, low), (share, high)]
            accuracy = sum(weight * row["all"]["accuracy_mean"] for weight, row in parts)
            return {"accuracy_mean": accuracy, "error": max(error_of(row) for _, row in parts)}
    return None


def largest(found: Rows) -> Rows:
    """Return, per task, the automaton that is farthest ahead of exact direct imaging."""
    best = []
    for name in TASKS:
        automata = [row for row in found if row["task"] == name and row["way"] in AUTOMATA]
        if automata:
            best.append(max(automata, key=lambda row: float(row["ahead"])))
    return best


def click_budgets(points: Rows) -> Rows:
    """Return the paper's rows, each with `ours`: of the automata with no more clicks on all images, the one that comes nearest to them.

    It is chosen by clicks, not by accuracy. Of the large automata of one level the one that was trained longest stands for all
    (`LONGER`). Rows without one have no `ours`.
    """
    automata = [row for row in points if row["way"] in AUTOMATA]
    longest: dict[tuple[str, float], str] = {}
    for row in sorted((row for row in automata if row["way"] in LONGER), key=lambda row: LONGER.index(row["way"])):
        longest[row["task"], row["level"]] = row["way"]
    automata = [row for row in automata if row["way"] not in LONGER or row["way"] == longest[row["task"], row["level"]]]
    found = []
    for name in TASKS:
        for printed in ACTIVE[name]:
            paper = next(
                row for row in points if (row["task"], row["way"], row["level"]) == (name, PAPER, printed.features)
            )
            of_task = [row for row in automata if row["task"] == name]
            below = [row for row in of_task if row["all"]["clicks_mean"] <= printed.clicks]
            line = {"task": name, "features": printed.features, "paper": paper}
            if below:
                ours = max(below, key=lambda row: float(row["all"]["clicks_mean"]))
                line |= {"ours": ours, "ahead": ours["all"]["accuracy_mean"] - paper[FIRST]["accuracy_mean"]}
            found.append(line)
    return found


def missing(rows: Rows) -> Rows:
    """Return the rows that say what is not measured yet."""
    return [row for row in rows if at(row, "missing") is not None]


def commands(rows: Rows) -> Rows:
    """Return the first row of each task and way that has a command of its own; of automata, whose sizes differ, of each level."""
    first: dict[tuple[str, str, float], Row] = {}
    for row in rows:
        if "command" in row:
            level = row["level"] if row["way"] in TRAINED else 0.0
            first.setdefault((row["task"], row["way"], level), row)
    return list(first.values())
