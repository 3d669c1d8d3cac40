"""The trained rows of the active tables, for the pages that measure them further: nothing is trained here.

Owns finding the bundles and figures that `pans reproduce fashion-mnist` and `mnist` leave in the cache folder, the words about rows
that are missing, and where that lies which was measured on a row. A figure that was kept for another bundle is measured again.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.trainer.paper_tables import ACTIVE, ActiveRow

from .active import PROFILE, finished_row, row_files
from .cache import kept
from .page import Asked

SPREADS_SAY = (
    "`trials` is the spread of one trial, `objects` the standard error from having few images; accuracies in %. Clicks, photons and "
    "illumination are of one decision, photons over all images."
)


@dataclass(frozen=True, slots=True, eq=False)
class TrainedRow:
    """A row of the paper, our bundle for it with its SHA-256, and the figures of its table; `current`: by the present recipe."""

    table: str
    paper: ActiveRow
    bundle: Bundle
    sha256: str
    figures: dict[str, Any]
    current: bool

    @property
    def features(self) -> int:
        """Number of patterns, d_f."""
        return self.paper.features


def trained_rows(asked: Asked, table: str) -> list[TrainedRow]:
    """Return the rows of `table` whose bundle and figures lie in the cache; what is missing is reported."""
    found = []
    for row in ACTIVE[table]:
        if not asked.wants(row.features):
            continue
        bundle_path, figures_path = row_files(asked.cache, table, row.features)
        if not (bundle_path.is_file() and figures_path.is_file()):
            asked.report(f"{table} d_f={row.features} is not trained yet: pans reproduce {table} --rows {row.features}")
            continue
        bundle, sha256 = load_bundle(bundle_path)
        figures = json.loads(figures_path.read_text())
        current = finished_row(asked.cache, table, row) is not None
        found.append(TrainedRow(table, row, bundle, sha256, figures, current))
    return found


def measured_on(
    asked: Asked, row: TrainedRow, facts: dict[str, Any], make: Callable[[], dict[str, Any]]
) -> dict[str, Any] | None:
    """Return what the page `asked.name` measured on `row` in the way of `facts`, now or before; with `collect` None where it did not."""

    def measured() -> dict[str, Any]:
        asked.report(f"{asked.name}: measuring {row.table}, d_f = {row.features}")
        return make()

    path = asked.cache / f"{asked.name}-{row.table}-{row.features}.json"
    return kept(path, {"sha256": row.sha256, **facts}, measured, collect=asked.collect)


def rows_say(table: str, rows: list[TrainedRow]) -> list[str]:
    """Return what a page says of its rows: which are missing, which are of an earlier recipe, where they come from."""
    there = {row.features for row in rows}
    missing = [str(row.features) for row in ACTIVE[table] if row.features not in there]
    earlier = [str(row.features) for row in rows if not row.current]
    said = [
        f"Bundles of `pans reproduce {table}` (seed 0), SHA-256: "
        + (", ".join(f"d_f = {row.features} `{row.sha256[:8]}`" for row in rows) + "." if rows else "none.")
    ]
    if missing:
        said.append(
            f"**Not here: d_f = {', '.join(missing)}**; train by `pans reproduce {table} --rows {' '.join(missing)}`."
        )
    if earlier:
        said.append(f"Trained by an earlier recipe than today's: d_f = {', '.join(earlier)}.")
    return said


def seconds_say(parts: list[dict[str, Any]]) -> str:
    """Return the words on how long the parts of a page took to measure."""
    return f"Measured in {sum(part['cpu_seconds'] for part in parts):.0f} processor seconds."


def profile_says() -> str:
    """Return the words on what simulates."""
    return (
        f"SIMULATED on the profile `{PROFILE}` (thresholded Poisson detector, perfect black), as the paper simulates."
    )


def table_head(*columns: str) -> list[str]:
    """Return the two lines that open a table."""
    return [f"| {' | '.join(columns)} |", "| --- " * len(columns) + "|"]
