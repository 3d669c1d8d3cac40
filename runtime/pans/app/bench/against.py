"""Rows of an earlier `pans bench loop --json` in, their ratios to the rows of now out: who made the loop slower sees it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import MIB, parse_json_object, read_file

from .rows import Row

ALLOWED = 1.15  # times p50 and p99 of before: five runs of the same loop in turn differed by up to 1.11
ALLOWED_LATE = 2.0  # more of 1000 decisions; chosen, so that a single stall is no loss
FIGURES = ("p50_us", "p99_us", "p999_us")
JUDGED = ("p50_us", "p99_us")


def read_rows(path: Path) -> dict[str, Row]:
    """Return the rows of a bench of the loop by name; DamagedFileError for a file that holds none, UsageError where it cannot be read."""
    remedy = "give what `pans bench loop --json` printed"
    found = parse_json_object(read_file(path, 16 * MIB), str(path))
    rows = found.get("rows")
    if not isinstance(rows, list):
        raise DamagedFileError(f"{path}: rows is {type(rows).__name__}, needed: a list", remedy=remedy)
    named = {row["name"]: row for row in rows if isinstance(row, dict) and isinstance(row.get("name"), str)}
    of_loop = {name: row for name, row in named.items() if row.get("bench") == "loop"}
    if not of_loop:
        raise DamagedFileError(f"{path}: it holds no row of `pans bench loop`", remedy=remedy)
    return of_loop


def compared(rows: list[Row], before: dict[str, Row]) -> tuple[list[Row], list[str]]:
    """Return a row of ratios (now / before) for each that both have, and one sentence for each loss."""
    found, losses = [], []
    for row in rows:
        name, was = str(row["name"]), before.get(str(row["name"]))
        if was is None:
            continue
        ratios = {figure: _ratio(row.get(figure), was.get(figure)) for figure in FIGURES}
        late, late_before = _late_per_1000(row), _late_per_1000(was)
        late_words = {"late_per_1000": late, "late_per_1000_before": late_before}
        found.append({"bench": "against", "name": name, **{f"{k}_ratio": v for k, v in ratios.items()}, **late_words})
        for figure in JUDGED:
            ratio = ratios[figure]
            if ratio is not None and ratio > ALLOWED:
                losses.append(f"{name}: {figure} {ratio:g} times that of before, allowed {ALLOWED:g}")
        if late is not None and late_before is not None and late > late_before + ALLOWED_LATE:
            losses.append(
                f"{name}: {late:g} of 1000 decisions late, before {late_before:g}, allowed {ALLOWED_LATE:g} more"
            )
    if not found:
        known = ", ".join(sorted(before))
        raise UsageError(f"no run of this bench was measured before; there: {known}", remedy="use the same --bundle")
    return found, losses


def _ratio(now: Any, before: Any) -> float | None:
    """The ratio of two figures, None where one of them is none."""
    this, that = _figure(now), _figure(before)
    return None if this is None or not that else round(this / that, 3)


def _late_per_1000(row: Row) -> float | None:
    """Late decisions of 1000, None where the row does not count them."""
    late, decisions = _figure(row.get("late")), _figure(row.get("decisions"))
    return None if late is None or not decisions else round(1000 * late / decisions, 2)


def _figure(value: Any) -> float | None:
    """A number as a file or a row has it; None for anything else, below 0 too."""
    return float(value) if type(value) in (int, float) and 0 <= value < math.inf else None
