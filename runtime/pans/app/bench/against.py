"""Rows of an earlier `pans bench loop --json` in, what has become of them out: a loss of pace is seen before it is shipped."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import MIB, parse_json_object, read_file

from .rows import Row

ALLOWED = 1.15  # times p50 and p99 of before: runs of the same code differ by so much
ALLOWED_LATE = 2.0  # more of 1000 decisions
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
    if not (_is_figure(now) and _is_figure(before)) or before <= 0:
        return None
    return round(now / before, 3)


def _late_per_1000(row: Row) -> float | None:
    late, decisions = row.get("late"), row.get("decisions")
    if not (_is_figure(late) and _is_figure(decisions)) or not decisions:
        return None
    return round(1000 * float(late or 0) / float(decisions or 1), 2)


def _is_figure(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)
