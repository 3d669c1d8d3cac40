"""The table of the index that counts what is above, level and below, page by page.

Owns the part of README.md between its two markers; made of the pages' rows alone. What the frontier claims is counted here, since its own
tables have no verdicts.
"""

from __future__ import annotations

import re
from pathlib import Path

from pans.runtime.outputs import replace_file
from pans.trainer.frontier.summary import by_point, click_budgets, error_of, margins
from pans.trainer.frontier.ways import TRAINED
from pans.trainer.paper.page import Column, Row, Rows, Table, read_rows
from pans.trainer.paper.tables import FIRST, FIRST_OBJECTS
from pans.trainer.verdicts import VERDICTS, Claim, against, claim, sampling_error

from .known import PAGES, page_of

INDEX = "README.md"
BEGIN, END = "<!-- counts: begin -->", "<!-- counts: end -->"


def index_counts(folder: Path) -> str:
    """Return the part of the index between its markers, of all pages whose NAME.json lies in `folder`."""
    return "\n".join([BEGIN, "", *index_table(folder, "[{page}]({page}.md)").lines(), "", END])


def index_table(folder: Path, page: str = "{page}") -> Table:
    """Return what every page of `folder` claims; `page` is the template of the first column."""
    keys = ("table", "ours", "against", "above", "level", "below", "of")
    there = [name for name in PAGES if (folder / f"{name}.json").is_file()]
    rows = [
        {"page": name, "table": heading, "ours": one.ours, "against": one.beside, "of": len(one.verdicts)}
        | dict(zip(VERDICTS, one.counts()))
        for name in there
        for heading, one in claims_of(name, read_rows(folder, name))
    ]
    return Table([Column("page", page), *(Column(key, f"{{{key}}}") for key in keys)], rows)


def claims_of(name: str, rows: Rows) -> list[tuple[str, Claim]]:
    """Return what a page claims, each with the heading of its table."""
    if name == "frontier":
        return _of_the_frontier(rows)
    tables: list[Table] = list(page_of(name).tables(rows))
    return [
        (re.split(r"[:(,]", table.heading.lstrip("# "))[0].strip(), one) for table in tables for one in table.claims
    ]


def _of_the_frontier(rows: Rows) -> list[tuple[str, Claim]]:
    """Automata at the paper's click budgets, ours of all images and the paper's of its first; and ways at the photons of direct imaging."""
    points = by_point(rows)
    budgets = []
    for row in (row for row in click_budgets(points) if "ours" in row):
        theirs = 100 * row["paper"][FIRST]["accuracy_mean"]
        errors = (100 * error_of(row["ours"]), sampling_error(theirs, FIRST_OBJECTS))
        budgets.append(against(100 * row["ours"]["all"]["accuracy_mean"], theirs, *errors))
    found = [("The paper's thirteen click budgets", claim("automata", "the paper's simulation", budgets))]
    beside = margins(points)
    for task, way in dict.fromkeys((row["task"], row["way"]) for row in beside):
        mine = [row for row in beside if (row["task"], row["way"]) == (task, way)]
        found.append((task, claim(way, "exact direct imaging at equal photons", _compared(mine))))
        sure = [row | row["sure"] for row in mine if "sure" in row]
        if sure and way in TRAINED:
            found.append((task, claim(way, "direct imaging that stops when sure, at equal photons", _compared(sure))))
    return found


def _compared(rows: Rows) -> list[Row]:
    return [
        against(100 * row["all"]["accuracy_mean"], 100 * row["beside"]["accuracy_mean"], 100 * row["error"])
        for row in rows
    ]


def rewrite_index(folder: Path) -> None:
    """Write the counts of the index again, where `folder` has an index with both markers."""
    path = folder / INDEX
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if begin and end:
        replace_file(path, (before + index_counts(folder) + after).encode())
