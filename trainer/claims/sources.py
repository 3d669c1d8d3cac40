"""What a page declares its numbers to be: columns of its tables, figures of its JSON, and what follows from them.

Owns the small language of the declarations. A name in quotes is a column by its header, in all tables that have it:

- `"4:ahead"` is of the fourth table alone; `"objects#2"` the second column of that header;
- `"fig-2e/ahead"` is of another page, `"counts/above"["page = cells"]` of the index;
- `"rows:final.value"` is what stands at that path in every row of the JSON file;
- `"ahead"["d_f = 3", "way = PANS"]` are the rows whose other columns (or paths) read so, `"ours"[0]` the first number of every cell;
- `+ - * /` work row by row, `> < ==` give 1 or 0; max, min, sum, mean, count, abs, log2 and last are what they say.

Nothing else of Python is understood. Values are as the column prints them (shares in percent), but not rounded.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pans.trainer.paper.page import FIELD, UNITS, Column, Row, Rows, Table, at, read_rows

from .index import index_table
from .known import PAGES, page_of

Values = list[float]
COUNTS = "counts"  # a page of its own: the table of counts of the index
VALUES_MAX = 40  # of one source: among more any number is found by chance
_OPERATORS: dict[type[ast.AST], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Gt: operator.gt,
    ast.Lt: operator.lt,
    ast.Eq: operator.eq,
}
_FUNCTIONS: dict[str, Callable[[Values], Values]] = {
    "max": lambda v: [max(v)],
    "min": lambda v: [min(v)],
    "sum": lambda v: [sum(v)],
    "mean": lambda v: [sum(v) / len(v)],
    "count": lambda v: [float(sum(x != 0 for x in v))],
    "last": lambda v: v[-1:],
    "abs": lambda v: [abs(x) for x in v],
    "log2": lambda v: [math.log2(x) for x in v],
    "rows": lambda v: [float(len(v))],
}


class Wrong(ValueError):
    """A declaration that cannot be read, with what is wrong."""


@dataclass(frozen=True, slots=True)
class Named:
    """A column of a page: its table (from 1), its header, its numbers row by row, and what tells its rows apart."""

    table: int
    header: str
    cells: list[Values]
    told_apart: Callable[[int, str], str | None]  # row, header: the cell as printed


class Figures:
    """The columns of all pages of a folder, read when they are asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._rows: dict[str, Rows] = {}
        self._columns: dict[str, list[Named]] = {}

    def rows(self, name: str) -> Rows:
        """Return the rows of NAME.json; none where there is no such file."""
        if name not in self._rows:
            there = (self.folder / f"{name}.json").is_file()
            self._rows[name] = read_rows(self.folder, name) if there else []
        return self._rows[name]

    def columns(self, name: str) -> list[Named]:
        """Return the columns of all tables of a page; none of a page without JSON."""
        if name not in self._columns:
            tables = self._tables(name)
            self._columns[name] = [
                _named(i, column, table.columns, table.rows)
                for i, table in enumerate(tables, start=1)
                for column in table.columns
            ]
        return self._columns[name]

    def _tables(self, name: str) -> list[Table]:
        if name == COUNTS:
            return [index_table(self.folder)]
        rows = self.rows(name)
        return list(page_of(name).tables(rows)) if name in PAGES and rows else []

    def values(self, name: str, source: str) -> Values:
        """Return the numbers that a declaration of page `name` stands for; `Wrong` says why there are none."""
        try:
            tree = ast.parse(source.strip(), mode="eval").body
            found = [value for cell in self._cells(name, tree) for value in cell]
        except (SyntaxError, ZeroDivisionError, RecursionError) as error:
            raise Wrong(f"{source}: {error}") from error
        if not found:
            raise Wrong(f"{source}: no number is found there")
        if len(found) > VALUES_MAX:
            raise Wrong(f'{source}: {len(found)} numbers, at most {VALUES_MAX} may be meant; name rows: ["d_f = 10"]')
        return found

    def _cells(self, name: str, node: ast.expr) -> list[Values]:
        match node:
            case ast.Constant(value=str(header)):
                return self._column(name, header, [])
            case ast.Constant(value=int() | float() as number):
                return [[float(number)]]
            case ast.Subscript(value=ast.Constant(value=str(header)), slice=chosen):
                return self._chosen(name, header, chosen)
            case ast.BinOp(left, op, right):
                return _joined(op, self._cells(name, left), self._cells(name, right))
            case ast.Compare(left, [op], [right]):
                return _joined(op, self._cells(name, left), self._cells(name, right))
            case ast.Call(func=ast.Name(id=function), args=[argument]) if function in _FUNCTIONS:
                flat = [value for cell in self._cells(name, argument) for value in cell]
                if not flat and function != "rows":
                    raise Wrong(f"{ast.unparse(argument)}: no number is found there")
                return [_FUNCTIONS[function](flat)]
        raise Wrong(f"{ast.unparse(node)}: not understood; see CONTRIBUTING.md, Numbers in pages of results")

    def _chosen(self, name: str, header: str, chosen: ast.expr) -> list[Values]:
        parts = [_plain(one) for one in (chosen.elts if isinstance(chosen, ast.Tuple) else [chosen])]
        cells = self._column(name, header, [part for part in parts if isinstance(part, str)])
        for place in (part for part in parts if isinstance(part, int)):
            cells = [cell[place : place + 1] for cell in cells]
        return cells

    def _column(self, name: str, header: str, where: Iterable[str]) -> list[Values]:
        page, _, rest = header.partition("/")
        if page in (*PAGES, COUNTS):
            name, header = page, rest
        wanted = [(key.strip(), value.strip()) for key, _, value in (one.partition(" = ") for one in where)]
        if header.startswith("rows:"):
            kept = [row for row in self.rows(name) if all(_reads(row, *one) for one in wanted)]
            return [_numbers(at(row, header.removeprefix("rows:"))) for row in kept]
        found = _called(self.columns(name), header)
        if not found:
            raise Wrong(f'"{header}": {name} has no such column')
        return [
            cell
            for column in found
            for i, cell in enumerate(column.cells)
            if all(column.told_apart(i, key) == value for key, value in wanted)
        ]


def _plain(node: ast.expr) -> str | int:
    if isinstance(node, ast.Constant) and isinstance(node.value, (str, int)):
        return node.value
    raise Wrong(f"{ast.unparse(node)}: rows are named in quotes, places by a number")


def _called(columns: list[Named], header: str) -> list[Named]:
    prefix = re.match(r"(\d+):", header)
    plain, _, nth = header[prefix.end() if prefix else 0 :].partition("#")
    found = [one for one in columns if one.header == plain and (not prefix or one.table == int(prefix[1]))]
    return found[int(nth) - 1 : int(nth)] if nth.isdigit() else found


def _named(table: int, column: Column, columns: Iterable[Column], rows: Iterable[Row]) -> Named:
    rows, by_header = list(rows), {one.header: one for one in reversed(list(columns))}

    def told_apart(i: int, header: str) -> str | None:
        return by_header[header].cell(rows[i]) if header in by_header else None

    return Named(table, column.header, [_of_cell(column, row) for row in rows], told_apart)


def _of_cell(column: Column, row: Row) -> Values:
    found: Values = []
    for path, form in FIELD.findall(column.template):
        unit = UNITS[form.partition(" ")[2]]
        found += [float(unit(value)) for value in _numbers(at(row, path))]
    return found


def _numbers(value: Any) -> Values:
    """The numbers in what JSON holds; of a text those that are written in it."""
    if isinstance(value, bool) or value is None:
        return []
    if isinstance(value, (int, float)):
        return [float(value)]
    if isinstance(value, str):
        return [float(one) for one in re.findall(r"(?<![\w.])[+-]?\d+(?:\.\d+)?", value)]
    parts = value.values() if isinstance(value, dict) else value
    return [one for part in parts for one in _numbers(part)]


def _reads(row: Row, path: str, wanted: str) -> bool:
    value = at(row, path)
    return wanted == (f"{value:g}" if isinstance(value, (int, float)) else str(value))


def _joined(op: ast.AST, left: list[Values], right: list[Values]) -> list[Values]:
    """Two columns row by row; a single number goes with every row."""
    if type(op) not in _OPERATORS:
        raise Wrong(f"{type(op).__name__}: not understood; allowed: + - * / > < ==")
    a, b = ([value for cell in side for value in cell] for side in (left, right))
    a, b = (side * max(len(a), len(b)) if len(side) == 1 else side for side in (a, b))
    if len(a) != len(b):
        raise Wrong(f"columns of {len(a)} and {len(b)} numbers do not go together")
    return [[float(_OPERATORS[type(op)](x, y))] for x, y in zip(a, b)]
