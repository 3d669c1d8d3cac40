"""A page of results: rows of figures, the tables made of them, pictures, and the files they become.

Owns the question (`Asked`), the finished parts of long work that lie in the cache folder (`kept`: a killed run goes on, and several pages
may share a part), the one writer of Markdown tables, and the files NAME.json, NAME.md and NAME*.png; never measures and never draws.
The tables of a page are made of its rows alone, so that NAME.json is enough to write them again. Whatever NAME.md says outside of the
two markers is written by hand and stays.
"""

from __future__ import annotations

import importlib.resources
import json
import re
import time
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pans.runtime.bundle.model import load_bundle
from pans.runtime.cli import say
from pans.runtime.errors import PansError, UsageError
from pans.runtime.outputs import check_outputs, make_folder, replace_file
from pans.trainer.options import Options, same_options
from pans.trainer.verdicts import Claim

NEEDS_PLOT = "pip install 'pans-runtime[plot]'"
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"
NOTHING = "-"  # a cell without a figure

Row = dict[str, Any]  # what JSON holds
Rows = list[Row]
Draw = Callable[[Path], None]


@dataclass(frozen=True, slots=True)
class Asked:
    """One page: finished parts lie in `cache`; `rows` are the only numbers of patterns wanted; with `collect` nothing is made.

    `dark` (dark counts wanted) and `data_seed` (draw of the generator) are of the tables over dark counts alone; `seeds` (how many) is of
    the frontier and of `equal-photons`, `results` (folder of other pages, whose rows are taken from there) of the frontier.
    """

    name: str
    cache: Path
    rows: tuple[int, ...] | None = None
    data_dir: str | None = None
    collect: bool = False
    report: Callable[[str], None] = say
    dark: tuple[float, ...] | None = None
    data_seed: int = 0
    seeds: int = 5
    results: Path | None = None

    def wants(self, features: int) -> bool:
        """Return whether the row of that many patterns was asked for."""
        return self.rows is None or features in self.rows


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its header, and the template of its cells (see pages.toml).

    >>> Column("all", "{all.accuracy_mean:.2f %}").cell({"all": {"accuracy_mean": 0.5}})
    '50.00'
    >>> Column("K = 1, 2", "{all.*.clicks:.1f}").cell({"all": {"1": {"clicks": 2}, "2": {"clicks": 4}}})
    '2.0 / 4.0'
    >>> Column("trials", "{spread:.2f}").cell({"spread": None})
    '-'
    """

    header: str
    template: str

    def cell(self, row: Row) -> str:
        """Return what stands in the column for `row`."""
        found = [(at(row, path), form) for path, form in FIELD.findall(self.template)]
        if any(value is None for value, _ in found):
            return NOTHING
        texts = iter([_written(value, form) for value, form in found])
        return FIELD.sub(lambda _: next(texts), self.template)


FIELD = re.compile(r"\{([^{}:]+):?([^{}]*)\}")  # path, format
UNITS: dict[str, Callable[[Any], Any]] = {
    "": lambda value: value,
    "%": lambda value: 100 * value,
    "min": lambda value: value / 60,
}


def _written(value: Any, form: str) -> str:
    if isinstance(value, (list, tuple)):
        return " / ".join(_written(one, form) for one in value)
    spec, _, unit = form.partition(" ")
    return format(UNITS[unit](value), spec)


@dataclass(frozen=True, slots=True)
class Table:
    """Columns over rows, below a heading (Markdown, none if empty); below them, how many rows are above, level and below."""

    columns: Sequence[Column]
    rows: Sequence[Row]
    heading: str = ""
    claims: Sequence[Claim] = ()

    def lines(self) -> list[str]:
        """Return the table as lines of Markdown."""
        head = [self.heading, ""] if self.heading else []
        cells = [[column.cell(row) for column in self.columns] for row in self.rows]
        return [
            *head,
            f"| {' | '.join(column.header for column in self.columns)} |",
            "| --- " * len(self.columns) + "|",
            *(f"| {' | '.join(line)} |" for line in cells),
            *(line for claim in self.claims for line in ("", claim.line())),
        ]


@dataclass(frozen=True, slots=True)
class Made:
    """What measuring a page gives: its rows, and what draws each picture at a path, by the end of its file's name ("" for NAME.png)."""

    rows: Rows
    pictures: Mapping[str, Draw] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Page:
    """A page: its title, what measures it, the tables made of its rows, the captions of its pictures by the end of their names.

    `trainings` says how many trainings stand behind a row.
    """

    title: str
    measure: Callable[[Asked], Made]
    tables: Callable[[Rows], Iterable[Table]]
    captions: Mapping[str, str] = field(default_factory=dict)
    trainings: str = ""

    def block(self, name: str, rows: Rows, pictures: Iterable[str]) -> str:
        """Return what is generated of the page: that it is simulated, its command, tables and pictures."""
        said = f" Trainings: {self.trainings}." if self.trainings else ""
        lines = [f"SIMULATED. Command: `pans reproduce {name}`.{said}", ""]
        for table in self.tables(rows):
            lines += [*table.lines(), ""]
        for ending in pictures:
            lines += [f"![{self.captions.get(ending, ending.lstrip('-') or name)}]({name}{ending}.png)", ""]
        return "\n".join([BEGIN, "", *lines, END])

    def around(self, block: str) -> str:
        """Return the page as it is where nothing was written by hand."""
        return f"# {self.title}\n\n{block}\n"


def at(row: Row, path: str) -> Any:
    """Return what stands in a row at a dotted path of keys and places (* for all values); None where one is missing.

    >>> at({"all": {"clicks": [4, 5]}}, "all.clicks.-1"), at({}, "all.clicks")
    (5, None)
    """
    found: Any = row
    for i, key in enumerate(keys := path.split(".")):
        if key == "*" and isinstance(found, dict):
            return [at(value, ".".join(keys[i + 1 :])) for value in found.values()]
        if isinstance(found, (list, tuple)):
            found = found[int(key)]
        elif isinstance(found, dict) and key in found:
            found = found[key]
        else:
            return None
    return found


_FILE: Row = tomllib.loads((importlib.resources.files(__package__) / "pages.toml").read_text(encoding="utf-8"))


def columns(*names: str) -> tuple[Column, ...]:
    """Return the columns of pages.toml of these names, one after the other."""
    parts = [part for name in names for part in _FILE["columns"][name]]
    groups = [columns(part) if isinstance(part, str) else (Column(*part),) for part in parts]
    return tuple(column for group in groups for column in group)


def pages(
    made_by: Mapping[str, tuple[Callable[[Asked], Made], Callable[[Rows], Iterable[Table]]]],
) -> dict[str, Page]:
    """Return pages with the titles and captions of pages.toml, each by its name and what measures it and makes its tables."""
    facts = _FILE["page"]
    return {
        name: Page(facts[name]["title"], *how, facts[name].get("pictures", {}), facts[name].get("trainings", ""))
        for name, how in made_by.items()
    }


def kept(path: Path, made_with: Row, make: Callable[[], Row], *, collect: bool) -> Row | None:
    """Return the part in `path` if it was made with `made_with`, else what `make` returns, after writing it there.

    `made_with` holds what JSON can; `cpu_seconds` (of this process) is added. With `collect` nothing is made: None.
    """
    plain = json.loads(json.dumps(made_with))
    found = cached_row(path, "made_with")
    if found is not None and found.get("made_with") == plain:
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


def finished(path: Path, options: Options) -> Row | None:
    """Return the figures in `path` if they are of a training with `options`, or None."""
    found = cached_row(path, "options")
    return found if found is not None and same_options(found["options"], options) else None


def cached_row(path: Path, *keys: str) -> Row | None:
    """Return what is in a file of the cache, None if it is not there; UsageError for what is no finished row with `keys`: it stays."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not found.keys() >= set(keys):
        raise UsageError(f"{path}: is no finished row", remedy="remove it, or name another folder with --cache")
    return found


def check_cached_bundle(path: Path) -> None:
    """Refuse to replace a bundle in the cache that was not made for a page: UsageError, before a row is trained."""

    def ours(found: Path) -> bool:
        try:
            return str(load_bundle(found)[0].provenance.get("command", "")).startswith("pans reproduce ")
        except PansError:
            return False

    check_outputs([path], ours=ours)


def page_files(folder: Path, name: str, page: Page) -> list[Path]:
    """Return the files of the page NAME in `folder`."""
    return [folder / f"{name}{ending}" for ending in (".json", ".md", *(f"{one}.png" for one in page.captions))]


def is_page_file(path: Path) -> bool:
    """Return whether a file is one that `write_page` wrote, and may write again; a picture is where the page's JSON file is."""
    try:
        if path.suffix == ".png":
            return any(is_page_file(one) for one in path.parent.glob("*.json") if path.stem.startswith(one.stem))
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".md":
            return BEGIN in text and END in text
        found = json.loads(text)
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(found, dict) and {"rows", "simulated"} <= found.keys()


def write_page(folder: Path, name: str, page: Page, made: Made) -> None:
    """Write NAME.json, NAME.md and the page's pictures, each whole or not at all."""
    make_folder(folder)
    text = json.dumps({"rows": made.rows, "simulated": True}, indent=1) + "\n"
    replace_file(folder / f"{name}.json", text.encode())
    _put(folder / f"{name}.md", page, page.block(name, made.rows, made.pictures))
    for ending, draw in made.pictures.items():
        try:
            draw(folder / f"{name}{ending}.png")
        except ModuleNotFoundError as error:
            raise UsageError("the picture needs matplotlib, which is not installed", remedy=NEEDS_PLOT) from error


def read_rows(folder: Path, name: str) -> Rows:
    """Return the rows of NAME.json."""
    rows: Rows = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))["rows"]
    return rows


def generated(folder: Path, name: str, page: Page) -> str:
    """Return the generated part of NAME.md as NAME.json and the pictures beside it give it."""
    there = [ending for ending in page.captions if (folder / f"{name}{ending}.png").is_file()]
    return page.block(name, read_rows(folder, name), there)


def rewrite_page(folder: Path, name: str, page: Page) -> None:
    """Write the generated part of NAME.md again, from NAME.json."""
    _put(folder / f"{name}.md", page, generated(folder, name, page))


def _put(path: Path, page: Page, block: str) -> None:
    """Write `block` between the markers of a page, or a new page where there is none."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    whole = before + block + after if begin and end else page.around(block)
    replace_file(path, whole.encode())
