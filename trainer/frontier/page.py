"""The page `frontier`: every row there is, the tables made of the rows, and the pictures.

Owns the list of the package's pages; of this one the order of the work (one seed of everything before the next) and the tables. Its recipes
are in ways.py.
"""

from __future__ import annotations

from functools import partial

from pans.trainer.paper.page import Asked, Draw, Made, Row, Rows, Table, columns, pages
from pans.trainer.paper.plots import TITLES
from pans.trainer.tasks.registry import Task, load_task

from . import pictures, plots
from .automata import bundle_path
from .fixed import PAPER, fixed_rows, paper_rows
from .one_photon import one_photon_page, one_photon_tables
from .reaching import reaching_page, reaching_tables
from .summary import by_point, click_budgets, commands, largest, margins, missing
from .ways import AUTOMATON, TASKS, Point, beyond_reach, points, row_of

SHOWN = ("fashion-mnist", 10.0)  # task and photons of the automaton that the pictures explain
ORDER = 0  # its seed


def frontier_page(asked: Asked) -> Made:
    """Return the paper's rows, those of other pages, one row per task, way, level and seed that is measured, and what is missing."""
    found, tasks = {}, _Tasks(asked)
    for seed in range(asked.seeds):
        for point in points():
            row = row_of(asked, point, seed, None)
            if row is None and not asked.collect:
                row = row_of(asked, point, seed, tasks[point.task])
            if row is not None:
                found[point, seed] = row
    done = [*paper_rows(), *fixed_rows(asked.results), *found.values()]
    return Made([*done, *_missing(asked, found)], _pictures(asked, done))


class _Tasks(dict[str, Task]):
    """Tasks by name, loaded when they are first asked for."""

    def __init__(self, asked: Asked) -> None:
        super().__init__()
        self.asked = asked

    def __missing__(self, name: str) -> Task:
        self[name] = load_task(name, self.asked.data_dir)
        return self[name]


def _missing(asked: Asked, found: dict[tuple[Point, int], Row]) -> Rows:
    """One row per task and way that lacks something: how many seeds of each level are measured, or known to be beyond reach."""
    lines: dict[tuple[str, str], list[str]] = {}
    for point in points():
        there = sum((point, seed) in found or beyond_reach(asked, point, seed) for seed in range(asked.seeds))
        if there < asked.seeds:
            lines.setdefault((point.task, point.way), []).append(f"{point.level:g}: {there} of {asked.seeds}")
    for (task, way), levels in lines.items():
        asked.report(f"frontier: {task}, {way}: not measured yet: {', '.join(levels)}")
    return [{"task": task, "way": way, "missing": ", ".join(levels)} for (task, way), levels in lines.items()]


def _pictures(asked: Asked, rows: Rows) -> dict[str, Draw]:
    drawn: dict[str, Draw] = {"": partial(plots.frontier, points=by_point(rows))}
    name, photons = SHOWN
    point = next(p for p in points() if (p.task, p.way, p.level) == (name, AUTOMATON, photons))
    path = bundle_path(asked.cache, point.stem, ORDER)
    if not path.is_file():
        asked.report(f"frontier: no pictures of an automaton yet: {path.name} is not trained")
        return drawn
    shown = pictures.shown_automaton(path, load_task(name, asked.data_dir))
    makers = {"-tree": pictures.tree, "-walks": pictures.walks, "-light": pictures.light, "-entropy": pictures.entropy}
    return drawn | {ending: partial(draw, shown=shown) for ending, draw in makers.items()}


def frontier_tables(rows: Rows) -> list[Table]:
    """Return the points of each task, the paper's, the margins over exact direct imaging, the click budgets, and what is missing."""
    summed = by_point(rows)
    ahead = margins(summed)
    tables = [
        Table(columns("point_largest"), largest(ahead), "## Farthest ahead of exact direct imaging at equal photons"),
        Table(columns("point_clicks"), click_budgets(summed), "## The paper's thirteen click budgets"),
    ]
    for name in TASKS:
        of_task = [row for row in summed if row["task"] == name]
        ordered = sorted(
            (row for row in of_task if row["way"] != PAPER), key=lambda row: (row["way"], row["all"]["photons_mean"])
        )
        printed = [row for row in of_task if row["way"] == PAPER]
        beside = [row for row in ahead if row["task"] == name]
        title = TITLES[name]
        tables += [
            Table(columns("point"), ordered, f"## {title}, accuracy %"),
            Table(columns("point_printed"), printed, f"## {title}, the paper's simulation, one shot"),
            Table(columns("point_margin"), beside, f"## {title}, ahead of exact direct imaging at equal photons"),
        ]
    tables.append(Table(columns("point_command"), commands(rows), "## Commands"))
    lacking = missing(rows)
    return [*tables, Table(columns("point_missing"), lacking, "## Not measured yet")] if lacking else tables


PAGES = pages(
    {
        "frontier": (frontier_page, frontier_tables),
        "reaching": (reaching_page, reaching_tables),
        "one-photon": (one_photon_page, one_photon_tables),
    }
)
