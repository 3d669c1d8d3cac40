"""A row of a page of results, and the rows of one of its tables."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]  # flat; "table" names the table of the page that it belongs to
Rows = list[Row]
_KEY = re.compile(r"\{(\w+)")


def of_table(rows: Rows, name: str) -> Rows:
    """Return the rows of one table of a page."""
    return [row for row in rows if row["table"] == name]


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its header, and the template of its cells.

    >>> Column("all", "{value:.2f} %").cell({"value": 50})
    '50.00 %'
    >>> Column("trials", "{spread:.2f}").cell({"spread": None})
    '-'
    """

    header: str
    template: str

    @property
    def keys(self) -> list[str]:
        """The keys of a row that the column needs."""
        return _KEY.findall(self.template)

    def cell(self, row: Row) -> str:
        """Return the cell of `row`: "-" where the row lacks a figure."""
        return "-" if any(row.get(key) is None for key in self.keys) else self.template.format(**row)
