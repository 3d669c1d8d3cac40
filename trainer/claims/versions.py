"""What the JSON of a page tells of the versions that its rows come from.

Owns the notes of the check: rows of different versions of the options, measurements of other bundles than those of their table, and rows
that were trained by another recipe than that of today, which the page's command would train anew.
"""

from __future__ import annotations

from collections.abc import Iterator

from pans.trainer.options import Options, same_options
from pans.trainer.paper import active, equal, passive_recipes
from pans.trainer.paper.page import Row, Rows
from pans.trainer.paper.tables import ACTIVE, PASSIVE, UNPRINTED, table_of

from .sources import Figures


def version_notes(figures: Figures, name: str) -> Iterator[str]:
    """Yield what the rows of a page tell of their versions."""
    rows = figures.rows(name)
    keys = {frozenset(row["options"]) for row in rows if "options" in row}
    if len(keys) > 1:
        missing = sorted(frozenset.union(*keys) - frozenset.intersection(*keys))
        yield f"rows of {len(keys)} versions: some lack the options {', '.join(missing)}"
    foreign = [row for row in rows if row.get("table") in ACTIVE and not _is_of_its_table(figures, row)]
    if foreign:
        which = ", ".join(dict.fromkeys(f"{row['table']} d_f = {row['features']}" for row in foreign))
        yield f"measured on other bundles than those of the table: {which}"
    earlier = _trained_otherwise(name, rows)
    if earlier:
        yield f"{len(earlier)} of {len(rows)} rows are of another recipe than today's: {', '.join(earlier)}"


def _is_of_its_table(figures: Figures, row: Row) -> bool:
    own = [one["sha256"] for one in figures.rows(row["table"]) if one["features"] == row["features"]]
    return row.get("sha256") in own


def _trained_otherwise(name: str, rows: Rows) -> list[str]:
    found = []
    for row in rows:
        today = _recipe(name, row) if "options" in row else None
        if today is not None and not same_options(row["options"], today):
            places = (f"{key} {row[key]}" for key in ("task", "way", "features", "dark", "asked") if key in row)
            found.append(" ".join(places))
    return found


def _recipe(name: str, row: Row) -> Options | None:
    """Return what the page's command would train a row with today; None where this page has no recipe per row."""
    if name in ACTIVE:
        return next((active.recipe(name, one) for one in ACTIVE[name] if one.features == row["features"]), None)
    if name in PASSIVE or name in UNPRINTED:
        printed = (one for one in table_of(name).rows if one.features == row["features"])
        return next((passive_recipes.recipe(name, one, row["dark"]) for one in printed), None)
    if name == "equal-photons":
        return equal.recipe_of_row(row)
    return None
