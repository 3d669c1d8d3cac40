"""A page of results: the request, its rows, the tables made of them, and the files they become.

The rows of NAME.json suffice to write the tables of a page again. Text outside of a page's two markers is written by hand and stays.
"""

from __future__ import annotations

import importlib.resources
import json
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pans.base.console import missing_extra, say
from pans.base.errors import PansError, UsageError
from pans.base.files import check_outputs, make_folder, replace_file
from pans.bundle.sensor import load_bundle
from pans_trainer.evaluate.walks import FIRST_OBJECTS as FIRST_OBJECTS
from pans_trainer.options import Options, same_options

from .plots import curves
from .rows import Column as Column
from .rows import Row as Row
from .rows import Rows as Rows
from .rows import of_table as of_table

Draw = Callable[[Path], None]

VERDICTS = ("above", "level", "below")
UNITS = {"photons": "photon", "illumination": "illumination"}  # of light, of which there are bits
RELEASE = "https://doi.org/10.5281/zenodo.19210131"  # data and code of the paper's authors, as the paper cites them
ERRORS = 2.0  # combined standard errors that a difference must exceed


def read_toml(name: str) -> Row:
    """Return a TOML file of this package."""
    return tomllib.loads((importlib.resources.files(__package__) / name).read_text(encoding="utf-8"))


_FILE = read_toml("pages.toml")
NAMES: tuple[str, ...] = tuple(_FILE["page"])


@dataclass(frozen=True, slots=True)
class Asked:
    """One page: finished parts are in `cache`; `rows` are the only numbers of patterns wanted; with `collect` nothing is measured.

    `dark` (dark counts wanted) and `data_seed` (draw of the generator) are for the tables over dark counts. For the frontier are `seeds`
    (how many), `ways` (the only ones wanted; None: all), and `known`, the page's rows as they are, kept where nothing new was measured.
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
    ways: tuple[str, ...] | None = None
    known: tuple[Row, ...] = ()

    def wants(self, features: int) -> bool:
        """Return whether the row of that many patterns was asked for."""
        return self.rows is None or features in self.rows

    def kept(self, name: str, made_with: Row, make: Callable[[], Row]) -> Row | None:
        """Return the part NAME.json of the cache if it was made with `made_with`, else what `make` returns, after writing it there.

        With `collect` nothing is made: a missing part is reported, and None returned.
        """
        path, plain = self.cache / f"{name}.json", json.loads(json.dumps(made_with))
        found = cached_row(path, "made_with")
        if found is not None and found.get("made_with") == plain:
            return found
        if self.collect:
            self.report(f"{self.name}: {name} is not measured yet")
            return None
        self.report(f"{self.name}: measuring {name}")
        text = json.dumps({"made_with": plain, **make()})
        replace_file(path, text.encode())
        whole: Row = json.loads(text)  # a part just made and one read again are the same to the caller
        return whole


@dataclass(frozen=True, slots=True)
class Made:
    """The rows of a page, and for each picture (by the end of its file's name) the function that draws it to a path."""

    rows: Rows
    pictures: Mapping[str, Draw] = field(default_factory=dict)


# ---- verdicts ----


def against(ours: float, theirs: float, *errors: float, prefix: str = "") -> Row:
    """Return `ahead`, `error` (independent `errors` of both sides, added in squares) and `verdict`, each key after `prefix`.

    >>> against(75.0, 70.0, 1.5, 2.0)
    {'ahead': 5.0, 'error': 2.5, 'verdict': 'level'}
    """
    ahead, error = ours - theirs, math.hypot(*errors)
    verdict = "level" if abs(ahead) <= ERRORS * error else "above" if ahead > 0 else "below"
    return {f"{prefix}ahead": ahead, f"{prefix}error": error, f"{prefix}verdict": verdict}


def sampling_error(percent: float, objects: int) -> float:
    """Return the binomial standard error in points of an accuracy on so many objects, for a figure that was printed without one.

    >>> round(sampling_error(74.31, 200), 2)
    3.09
    """
    share = percent / 100
    return 100 * math.sqrt(share * (1 - share) / objects)


def flat(whole: Row, first: Row) -> Row:
    """Return the figures of all objects and of the first 200 (rows as `row_of` gives them) under one set of keys; accuracies in %."""
    keys = {"accuracy_mean": "value", "accuracy_std": "spread_trials", "accuracy_se_objects": "error_objects"}
    firsts = {"accuracy_mean": "first_200", "accuracy_std": "first_spread", "accuracy_se_objects": "first_error"}
    parts = ((keys, whole), (firsts, first))  # an exact expectation over walks has no spread of trials
    found = {new: 100 * row[key] for names, row in parts for key, new in names.items() if key in row}
    light = {"clicks": whole["clicks_mean"], "photons": whole["photons_mean"], "illumination": whole["illumination"]}
    found |= light | {"first_clicks": first["clicks_mean"], "first_photons": first["photons_mean"]}
    return found | {key: whole[key] for key in ("objects", "trials") if key in whole}


def by_epoch(columns: Row, **facts: Any) -> Rows:
    """Return one row per epoch of the table `epochs` from columns over the epochs."""
    rows = [dict(zip(columns, values)) for values in zip(*columns.values())]
    return [{"table": "epochs", **facts, "epoch": number} | row for number, row in enumerate(rows, start=1)]


def interpolated(curve: Rows, place: float, of: str, value: str = "value") -> float | None:
    """Return a curve's `value` where its figure `of` is `place`, linear in the logarithm of `of`; None outside of the curve."""
    known = sorted((float(row[of]), float(row[value])) for row in curve)
    if not known or not known[0][0] <= place <= known[-1][0]:
        return None
    return float(np.interp(math.log(place), [math.log(x) for x, _ in known], [y for _, y in known]))


def beside_curve(row: Row, curve: Rows, of: str, prefix: str = "", place: float | None = None) -> Row:
    """Hold a row against a curve where that has as much of `of` (or `place` of it): its value as `there`, and the verdict; {} outside."""
    there, error = (
        interpolated(curve, row[of] if place is None else place, of, key) for key in ("value", "error_objects")
    )
    if there is None or error is None:
        return {}
    return {f"{prefix}there": there} | against(row["value"], there, row["error_objects"], error, prefix=prefix)


# ---- tables ----


@dataclass(frozen=True, slots=True)
class Table:
    """Columns over the rows of one table that have `needs`; with `across` one column per value of that column, its cells by `cell`.

    `claims` name columns of verdicts, which are counted below the table: (ours, the other side, key).
    """

    of: str
    columns: tuple[Column, ...]
    heading: str = ""
    claims: tuple[tuple[str, str, str], ...] = ()
    across: Column | None = None
    cell: str = ""
    needs: str = "table"

    @property
    def keys(self) -> list[str]:
        """The keys of a row that the table needs."""
        every = (*self.columns, Column("", self.cell), *((self.across,) if self.across else ()))
        return [key for column in every for key in column.keys] + [
            key for *_, verdict in self.claims for key in (verdict, _ahead(verdict))
        ]

    def rows(self, rows: Rows) -> Rows:
        """Return the rows of a page that the table shows."""
        return [row for row in of_table(rows, self.of) if row.get(self.needs)]

    def lines(self, rows: Rows) -> list[str]:
        """Return the table of a page's rows as lines of Markdown; nothing without rows."""
        mine = self.rows(rows)
        if not mine:
            return []
        heads, body = [column.header for column in self.columns], [[c.cell(row) for c in self.columns] for row in mine]
        if self.across:
            wide = dict.fromkeys(self.across.cell(row) for row in mine)
            groups: dict[tuple[str, ...], dict[str, str]] = {}
            for row, cells in zip(mine, body):
                groups.setdefault(tuple(cells), {})[self.across.cell(row)] = Column("", self.cell).cell(row)
            body = [[*group, *(cells.get(head, "-") for head in wide)] for group, cells in groups.items()]
            heads += wide
        return [
            *([f"### {self.heading}", ""] if self.heading else []),
            "|".join(heads),
            "|".join(["---"] * len(heads)),
            *("|".join(cells) for cells in body),
            "",
            *(line for claim in self.claims for line in (_counted(*claim, mine), "")),
        ]


def _ahead(verdict: str) -> str:
    """Return the key of the difference that the key `verdict` judges."""
    return verdict.replace("verdict", "ahead")


def _counted(ours: str, theirs: str, key: str, rows: Rows) -> str:
    """Return the verdicts by number, and in how many rows ours are higher: differences that are level may all have one sign."""
    judged = [row for row in rows if row.get(key)]
    found, ahead = (
        [row[key] for row in judged],
        [row[_ahead(key)] for row in judged if row.get(_ahead(key)) is not None],
    )
    counts = ", ".join(f"{found.count(one)} {one}" for one in VERDICTS)
    higher = f"; higher in {sum(one > 0 for one in ahead)}" if len(ahead) == len(found) else ""
    return f"{ours} against {theirs}: {counts}, of {len(found)}{higher}."


def _columns(parts: Iterable[Any]) -> tuple[Column, ...]:
    """Return columns from pages.toml: the name of a group, or a header and a template."""
    groups = [_columns(_FILE["columns"][part]) if isinstance(part, str) else (Column(*part),) for part in parts]
    return tuple(column for group in groups for column in group)


# ---- pages ----


@dataclass(frozen=True, slots=True)
class Page:
    """An entry of pages.toml: title, module:function that measures it, tables, captions of pictures, and its Markdown file if not NAME.md.

    `plots` names the [plots] entry of each picture that is drawn from the rows alone; the others are drawn by the module. `paper` says
    where the paper's figures are from: its text, a figure, or the authors' release.
    """

    name: str
    title: str
    make: str
    trainings: str
    tables: tuple[Table, ...] = ()
    pictures: Mapping[str, str] = field(default_factory=dict)
    plots: Mapping[str, str] = field(default_factory=dict)
    file: str = ""
    paper: str = ""

    def drawn(self, made: Made) -> Made:
        """Return `made` with the pictures that are drawn from its rows alone."""
        specs = {ending: _FILE["plots"][name] for ending, name in self.plots.items()} if made.rows else {}
        pictures = {ending: partial(curves, rows=made.rows, spec=spec) for ending, spec in specs.items()}
        return Made(made.rows, {**pictures, **made.pictures})

    @property
    def markdown(self) -> str:
        """The name of the Markdown file, which several pages may share."""
        return f"{self.file or self.name}.md"

    @property
    def markers(self) -> tuple[str, str]:
        """The lines of the Markdown file between which the page is generated."""
        return f"<!-- {self.name}: begin -->", f"<!-- {self.name}: end -->"

    def block(self, rows: Rows, pictures: Iterable[str]) -> str:
        """Return what is generated: command, tables and pictures, between the markers."""
        source = (
            f" The paper's figures: {self.paper}.".replace("release", f"[release]({RELEASE})") if self.paper else ""
        )
        lines = [f"SIMULATED. Command: `pans reproduce {self.name}`. Trainings: {self.trainings}.{source}", ""]
        for table in self.tables:
            lines += table.lines(rows)
        for ending in pictures:
            lines += [f"![{self.pictures.get(ending, ending)}]({self.name}{ending}.png)", ""]
        begin, end = self.markers
        return "\n".join([begin, "", *lines, end])

    def files(self, folder: Path) -> list[Path]:
        """Return the page's files in `folder`."""
        ends = (f"{self.name}.json", self.markdown, *(f"{self.name}{one}.png" for one in self.pictures))
        return [folder / end for end in ends]


def page_of(name: str) -> Page:
    """Return the page of that name; KeyError for a name that is not in `NAMES`."""
    facts = _FILE["page"][name]
    tables = []
    for one in facts.get("tables", ()):
        parts = {"columns": _columns(one["columns"]), "claims": tuple(map(tuple, one.get("claims", ())))}
        tables.append(Table(**one | parts | ({"across": Column(*one["across"])} if "across" in one else {})))
    return Page(**facts | {"name": name, "tables": tuple(tables)})


def page_json(page: Page, rows: Rows) -> str:
    """Return NAME.json: per table a header and one line per row, with the rows and keys that the tables of the page show."""
    parts = []
    for name in dict.fromkeys(table.of for table in page.tables):
        tables = [table for table in page.tables if table.of == name]
        used = {key for table in tables for key in (table.needs, *table.keys)} - {"table"}
        mine = [row for row in of_table(rows, name) if any(row.get(table.needs) for table in tables)]
        keys = [key for key in dict.fromkeys(key for row in mine for key in row) if key in used]
        lines = ",\n".join(json.dumps([row.get(key) for key in keys]) for row in mine)
        parts.append(f'{json.dumps(name)}: {{"columns": {json.dumps(keys)}, "rows": [\n{lines}\n]}}')
    return '{"simulated": true, "tables": {\n' + ",\n".join(parts) + "\n}}\n"


def read_rows(folder: Path, name: str) -> Rows:
    """Return the rows of NAME.json; UsageError where it is not there or no page of results."""
    path = folder / f"{name}.json"
    try:
        tables = json.loads(path.read_text(encoding="utf-8"))["tables"]
        return [{"table": t, **dict(zip(of["columns"], row))} for t, of in tables.items() for row in of["rows"]]
    except FileNotFoundError as error:
        raise UsageError(f"{path} is not there", remedy=f"measure it: pans reproduce {name} -o {folder}") from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UsageError(f"{path} is no page of results", remedy="remove it and measure it again") from error


def is_page_file(path: Path) -> bool:
    """Return whether a file was written by `write_page`, and may be written again; a picture is where its page's JSON file is."""
    try:
        if path.suffix == ".png":
            return any(is_page_file(one) for one in path.parent.glob("*.json") if path.stem.startswith(one.stem))
        text = path.read_text(encoding="utf-8")
        return ": begin -->" in text if path.suffix == ".md" else {"tables", "simulated"} <= json.loads(text).keys()
    except (OSError, ValueError, RecursionError, AttributeError):
        return False


def write_page(folder: Path, page: Page, made: Made) -> None:
    """Write NAME.json, the page's part of its Markdown file, and its pictures, each whole or not at all."""
    made = page.drawn(made)
    make_folder(folder)
    replace_file(folder / f"{page.name}.json", page_json(page, made.rows).encode())
    _put(folder, page, page.block(made.rows, made.pictures))
    for ending, draw in made.pictures.items():
        try:
            draw(folder / f"{page.name}{ending}.png")
        except ModuleNotFoundError as error:
            raise missing_extra("the picture", "matplotlib", "plot") from error


def generated(folder: Path, page: Page) -> str:
    """Return the generated part of a page as NAME.json and the pictures in `folder` give it."""
    there = [ending for ending in page.pictures if (folder / f"{page.name}{ending}.png").is_file()]
    return page.block(read_rows(folder, page.name), there)


def rewrite_page(folder: Path, page: Page) -> None:
    """Write the generated part of a page again, from NAME.json."""
    _put(folder, page, generated(folder, page))


def _put(folder: Path, page: Page, block: str) -> None:
    path = folder / page.markdown
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    begin, end = page.markers
    if begin in text and end in text:
        whole = text[: text.index(begin)] + block + text[text.index(end) + len(end) :]
    else:
        whole = f"{text}\n" * bool(text) + f"# {page.title}\n\n{block}\n"
    replace_file(path, whole.encode())


# ---- finished parts ----


def finished(path: Path, options: Options) -> Row | None:
    """Return the figures in `path` if they are of a training with `options`, or None."""
    found = cached_row(path, "options")
    return found if found is not None and same_options(found["options"], options) else None


def cached_row(path: Path, *keys: str) -> Row | None:
    """Return the content of a file of the cache, None if it is not there; UsageError for one that is no finished row with `keys`."""
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
