"""A page of results: rows of figures, the tables made of them, pictures, and the files they become.

Owns the question (`Asked`), the finished parts of long work that lie in the cache folder (`kept`: a killed run goes on, and several pages
may share a part), the one writer of Markdown tables, and the files NAME.json, NAME.md and NAME*.png; never measures and never draws.
The tables of a page are made of its rows alone, so that NAME.json is enough to write them again. Whatever NAME.md says outside of the
two markers is written by hand and stays.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pans.runtime.cli import say
from pans.runtime.container import replace_file
from pans.runtime.errors import UsageError

NEEDS_PLOT = "pip install 'pans-runtime[plot]'"
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"
NOTHING = "-"  # a cell without a figure

Row = dict[str, Any]  # what JSON holds
Rows = list[Row]
Draw = Callable[[Path], None]


@dataclass(frozen=True, slots=True)
class Asked:
    """One page: finished parts lie in `cache`; `rows` are the only numbers of patterns wanted; with `collect` nothing is made.

    `dark` (dark counts wanted) and `data_seed` (draw of the generator) are of the tables over dark counts alone.
    """

    name: str
    cache: Path
    rows: tuple[int, ...] | None = None
    data_dir: str | None = None
    collect: bool = False
    report: Callable[[str], None] = say
    dark: tuple[float, ...] | None = None
    data_seed: int = 0

    def wants(self, features: int) -> bool:
        """Return whether the row of that many patterns was asked for."""
        return self.rows is None or features in self.rows


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its header, what it takes from a row (a dotted path, or a function), and how a number is written.

    >>> Column("all", "all.accuracy_mean", ".2f", scale=100).cell({"all": {"accuracy_mean": 0.5}})
    '50.00'
    >>> Column("trials", "spread", ".2f").cell({"spread": None})
    '-'
    """

    header: str
    value: str | Callable[[Row], Any]
    form: str = ""
    scale: float = 1

    def cell(self, row: Row) -> str:
        """Return what stands in the column for `row`: a text as it is, a number in the column's format, "-" for nothing."""
        found = at(row, self.value) if isinstance(self.value, str) else self.value(row)
        if found is None:
            return NOTHING
        return found if isinstance(found, str) else format(self.scale * found, self.form)


@dataclass(frozen=True, slots=True)
class Table:
    """Columns over rows, below a heading (Markdown, none if empty)."""

    columns: Sequence[Column]
    rows: Iterable[Row]
    heading: str = ""

    def lines(self) -> list[str]:
        """Return the table as lines of Markdown."""
        head = [self.heading, ""] if self.heading else []
        cells = [[column.cell(row) for column in self.columns] for row in self.rows]
        return [
            *head,
            f"| {' | '.join(column.header for column in self.columns)} |",
            "| --- " * len(self.columns) + "|",
            *(f"| {' | '.join(line)} |" for line in cells),
        ]


@dataclass(frozen=True, slots=True)
class Made:
    """What measuring a page gives: its rows, and what draws each picture at a path, by the end of its file's name ("" for NAME.png)."""

    rows: Rows
    pictures: Mapping[str, Draw] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Page:
    """A page: its title, what measures it, the tables made of its rows, and the captions of its pictures by the end of their names."""

    title: str
    measure: Callable[[Asked], Made]
    tables: Callable[[Rows], Iterable[Table]]
    captions: Mapping[str, str] = field(default_factory=dict)

    def block(self, name: str, rows: Rows, pictures: Iterable[str]) -> str:
        """Return what is generated of the page: that it is simulated, its command, tables and pictures."""
        lines = [f"SIMULATED. Command: `pans reproduce {name}`.", ""]
        for table in self.tables(rows):
            lines += [*table.lines(), ""]
        for ending in pictures:
            lines += [f"![{self.captions.get(ending, ending.lstrip('-') or name)}]({name}{ending}.png)", ""]
        return "\n".join([BEGIN, "", *lines, END])

    def whole(self, name: str, made: Made) -> str:
        """Return the page as it is where nothing was written by hand."""
        return f"# {self.title}\n\n{self.block(name, made.rows, made.pictures)}\n"


def at(row: Row, path: str) -> Any:
    """Return what stands in a row at a dotted path of keys; None where a key is missing.

    >>> at({"all": {"clicks": 5}}, "all.clicks"), at({}, "all.clicks")
    (5, None)
    """
    found: Any = row
    for key in path.split("."):
        if not isinstance(found, dict) or key not in found:
            return None
        found = found[key]
    return found


def percent(header: str, value: str | Callable[[Row], Any], form: str = ".2f") -> Column:
    """Return a column of shares, written in percent."""
    return Column(header, value, form, scale=100)


def accuracy(header: str, part: str = "", form: str = ".2f") -> tuple[Column, Column, Column]:
    """Return accuracy in %, the spread of one trial and the standard error from having few objects, of a part of the rows."""
    prefix = f"{part}." if part else ""
    return (
        percent(header, f"{prefix}accuracy_mean", form),
        percent("trials", f"{prefix}accuracy_std", form),
        percent("objects", f"{prefix}accuracy_se_objects", form),
    )


def light(part: str = "", clicks: str = "clicks") -> tuple[Column, Column, Column]:
    """Return clicks, photons and illumination of a part of the rows."""
    prefix = f"{part}." if part else ""
    return (
        Column(clicks, f"{prefix}clicks_mean", ".2f"),
        Column("photons", f"{prefix}photons_mean", ".1f"),
        Column("illumination", f"{prefix}illumination", ".0f"),
    )


MINUTES = Column("minutes", lambda row: row["cpu_seconds"] / 60, ".1f")  # of the processor


def kept(path: Path, made_with: Row, make: Callable[[], Row], *, collect: bool) -> Row | None:
    """Return the part in `path` if it was made with `made_with`, else what `make` returns, after writing it there.

    `made_with` holds what JSON can; `cpu_seconds` (of this process) is added. With `collect` nothing is made: None.
    """
    plain = json.loads(json.dumps(made_with))
    if path.is_file():
        found: Row = json.loads(path.read_text(encoding="utf-8"))
        if found.get("made_with") == plain:
            return found
    if collect:
        return None
    started = time.process_time()
    part = make()
    # through JSON: a part just made and one read again are the same to the caller
    text = json.dumps({"made_with": plain, "cpu_seconds": time.process_time() - started, **part})
    replace_file(path, text.encode())
    whole: Row = json.loads(text)
    return whole


def write_page(folder: Path, name: str, page: Page, made: Made) -> None:
    """Write NAME.json, NAME.md and the page's pictures, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"rows": made.rows, "simulated": True}, indent=1) + "\n"
    replace_file(folder / f"{name}.json", text.encode())
    _write_tables(folder, name, page, made)
    for ending, draw in made.pictures.items():
        try:
            draw(folder / f"{name}{ending}.png")
        except ModuleNotFoundError as error:
            raise UsageError("the picture needs matplotlib, which is not installed", remedy=NEEDS_PLOT) from error


def read_page(folder: Path, name: str, page: Page) -> str:
    """Return the generated part of NAME.md as NAME.json and the pictures beside it give it."""
    rows = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))["rows"]
    there = [ending for ending in page.captions if (folder / f"{name}{ending}.png").is_file()]
    return page.block(name, rows, there)


def _write_tables(folder: Path, name: str, page: Page, made: Made) -> None:
    path = folder / f"{name}.md"
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if begin and end:
        whole = before + page.block(name, made.rows, made.pictures) + after
    else:
        whole = page.whole(name, made)
    replace_file(path, whole.encode())
