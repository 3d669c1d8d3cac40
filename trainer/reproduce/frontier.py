"""The frontier: accuracy against photons, clicks, exposures and illumination, of automata and of everything they are compared with.

A point is one way at one level of one task (frontier.toml), measured from several seeds: one seed of everything comes before the next.
Finished rows and bundles stay in the cache folder. Fixed patterns of the pages `fashion-mnist`, `mnist` and `alpha` are taken from there.
"""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

from pans.runtime.bundle.model import load_bundle
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive.options import AutomatonOptions, for_task, started_from, with_defaults
from pans.trainer.baselines.common import silent
from pans.trainer.baselines.options import BaselineOptions
from pans.trainer.baselines.rows import baseline_rows
from pans.trainer.evaluate.accuracy import row_of
from pans.trainer.options import Options
from pans.trainer.tasks.registry import Task, load_task

from .active import OTHER_SEEDS, PROFILE, finished_row, shot_figures
from .dynamics import ALPHAS, training
from .page import (
    FIRST_OBJECTS,
    Asked,
    Made,
    Row,
    Rows,
    against,
    check_cached_bundle,
    flat,
    interpolated,
    kept,
    read_toml,
    sampling_error,
)
from .printed import ACTIVE

WAYS: list[Row] = read_toml("frontier.toml")["way"]
EXACT, STOPPING = "direct, exact posterior", "direct, stops when sure"
FIXED, FIXED_LIGHT = "ours, fixed, held to clicks", "ours, fixed, light weighed"
LONGER = (
    "automaton",
    "automaton, trained on",
    "larger automaton",
    "larger automaton, trained on",
    "larger automaton, trained on twice",
)
BUDGETED = (
    *LONGER,
    "small automaton",
    "automaton, held to clicks",
)  # ways that the paper's click budgets are compared with
MEANS = ("exposures", "value", "error_objects", "first_200", "clicks", "photons", "illumination")


@dataclass(frozen=True, slots=True)
class Point:
    """One way at one level of one task: the kind of recipe, and its options but for the seed."""

    task: str
    way: str
    level: float
    kind: str
    options: tuple[tuple[str, Any], ...]
    start: Point | None = None

    @property
    def stem(self) -> str:
        """What its files in the cache are called, but for the seed."""
        return f"frontier-{self.task}-{self.way.replace(',', '').replace(' ', '-').lower()}-{self.level:g}"

    def training_seed(self, seed: int) -> int:
        """Return the seed of the training: the next one after that of the automaton it starts from, for other distortions."""
        return seed if self.start is None else self.start.training_seed(seed) + 1

    def made_with(self, seed: int) -> Row:
        """Return the whole recipe of a row: one that was made with another is made again."""
        start = {} if self.start is None else {"start": self.start.made_with(seed)}
        return {"kind": self.kind, **dict(self.options), "seed": self.training_seed(seed), **start}


def points() -> Iterator[Point]:
    """Yield all points of frontier.toml, way by way."""
    known: dict[tuple[str, str, float], Point] = {}
    for way in WAYS:
        for task, levels in way["levels"].items():
            for text, more in levels.items():
                level = float(text)
                start = known[task, way["start"], level] if "start" in way else None
                options = tuple((way["options"] | more).items())
                known[task, way["name"], level] = Point(task, way["name"], level, way["kind"], options, start)
    yield from known.values()


# ---- measuring a point ----


def point_row(asked: Asked, point: Point, seed: int) -> Row | None:
    """Return the flat figures of a point from one seed, from the cache or measured now; None where it is missing."""
    path, options = asked.cache / f"{point.stem}-seed{seed}.json", point.made_with(seed)
    make: Callable[[], Row] = partial(_KINDS[point.kind], asked, point, seed)
    if point.way == STOPPING:  # made for all levels at once: they are read off the same photons
        levels = [other.level for other in points() if (other.task, other.way) == (point.task, STOPPING)]
        path, options = asked.cache / f"frontier-{point.task}-stopping-seed{seed}.json", options | {"levels": levels}
        make = partial(_stopping, asked, point, seed, levels)
    found = kept(path, options, make, collect=asked.collect)
    if found is not None and point.way == STOPPING:  # levels that it cannot reach are left out
        found = found["levels"].get(f"{point.level:g}")
    return found


@functools.lru_cache(maxsize=1)  # the points of a task share it
def _task(name: str, data_dir: str | None) -> Task:
    return load_task(name, data_dir)


def _baseline(asked: Asked, point: Point, seed: int) -> Row:
    options = BaselineOptions(**dict(point.options), seed=seed)
    (row,) = baseline_rows(_task(point.task, asked.data_dir), options, [point.level], silent)
    exposures = {"fsi": 1, "hadamard": 2}.get(
        options.paradigm, 0
    ) * options.features or 1  # one per mask, two per pair, one frame
    return flat(row, row["first_200"]) | {"exposures": exposures}


def _stopping(asked: Asked, point: Point, seed: int, levels: list[float]) -> Row:
    options = BaselineOptions(**dict(point.options), seed=seed)
    rows = baseline_rows(_task(point.task, asked.data_dir), options, levels, silent)
    return {"levels": {f"{row['photons_asked']:g}": flat(row, row["first_200"]) | {"exposures": 1} for row in rows}}


def _fixed(asked: Asked, point: Point, seed: int) -> Row:
    from pans.trainer.train.loop import train

    from .passive import measure

    task, options = _task(point.task, asked.data_dir), Options(**dict(point.options), seed=seed)
    found = measure(point.task, task, train(task, load_profile(PROFILE), options))
    return found | {"exposures": options.features}


def _automaton(asked: Asked, point: Point, seed: int) -> Row:
    from pans.trainer.export.automaton import measure_walks

    task, profile = _task(point.task, asked.data_dir), load_profile(PROFILE)
    bundle, _ = load_bundle(trained_automaton(asked, point, seed))
    whole, first = (row_of(measure_walks(bundle, task.test.first(count), profile)) for count in (None, FIRST_OBJECTS))
    return flat(whole, first) | {"exposures": whole["exposures_mean"]}


_KINDS: dict[str, Callable[[Asked, Point, int], Row]] = {
    "baseline": _baseline,
    "fixed": _fixed,
    "automaton": _automaton,
}


def trained_automaton(asked: Asked, point: Point, seed: int) -> Path:
    """Return where the automaton of a point is, trained now unless one of the same recipe is there; what it starts from comes first."""
    from pans.trainer.adaptive.train import train_automaton
    from pans.trainer.device import keep_freed_memory
    from pans.trainer.export.automaton import export_automaton

    path, task, profile = (
        asked.cache / f"{point.stem}-seed{seed}.pans",
        _task(point.task, asked.data_dir),
        load_profile(PROFILE),
    )
    start = None if point.start is None else load_bundle(trained_automaton(asked, point.start, seed))
    options = AutomatonOptions(seed=point.training_seed(seed), **dict(point.options))
    if start is None:
        exposures, states = with_defaults(options, profile)
        options = replace(options, exposures=exposures, states=states)
    else:
        options = started_from(options, *start, task, profile)
    options = for_task(options, point.task)
    if path.is_file() and asdict(options).items() <= dict(load_bundle(path)[0].provenance.get("options", {})).items():
        return path
    check_cached_bundle(path)
    keep_freed_memory()
    checkpoint = path.with_suffix(".checkpoint")
    trained = train_automaton(
        task,
        profile,
        options,
        checkpoint=checkpoint,
        resume=checkpoint.is_file(),
        report=lambda at: (
            asked.report(f"{path.stem}: {at.stage}, {at.done} of {at.steps}") if at.done % 8 == 0 else None
        ),
        teacher=asked.cache / f"frontier-{task.name}-soft-targets.npz",  # of all seeds
        start=None if start is None else start[0],
    )
    provenance = {"command": "pans reproduce frontier", "options": asdict(options)}
    export_automaton(path, trained, task, profile, name=path.stem, provenance=provenance, force=True)
    checkpoint.unlink(missing_ok=True)
    return path


def fixed_rows(asked: Asked) -> Rows:
    """Return our fixed patterns from the finished parts of the pages `fashion-mnist`, `mnist` and `alpha`, none of them measured now."""
    rows: Rows = []
    for name, table in ACTIVE.items():
        for row in table:
            for seed in (0, *OTHER_SEEDS.get((name, row.features), ())):
                figures = finished_row(asked.cache, name, row, seed)
                if figures is not None:
                    rows.append(
                        {"task": name, "way": FIXED, "level": float(row.features), "exposures": row.features}
                        | shot_figures(figures)
                    )
    for alpha in ALPHAS[1:]:
        found = training(replace(asked, collect=True, report=lambda _: None), 32, alpha)
        if found is not None:
            rows.append({"task": "fashion-mnist", "way": FIXED_LIGHT, "level": alpha, "exposures": 32} | found["final"])
    return rows


# ---- the page ----


def photons_at_least(clicks: float, features: int) -> float:
    """Return the least photoelectrons of that many clicks of so many thresholded exposures: -d_f ln(1 - clicks / d_f).

    The mean of lambda over exposures is least, for a given mean of 1 - exp(-lambda), where all are equal (Jensen).

    >>> round(photons_at_least(4.939, 10), 2)
    6.81
    """
    if not 0 <= clicks < features:
        raise ValueError(f"{clicks:g} clicks of {features} exposures, allowed: below {features}, at least 0")
    return -features * math.log1p(-clicks / features)


def frontier_page(asked: Asked) -> Made:
    """Return one row per point beside direct imaging at its photons, and the paper's click budgets beside our automata."""
    measured: Rows = []
    for seed in range(asked.seeds):
        for point in points():
            found = point_row(asked, point, seed)
            if found is not None:
                measured.append({"task": point.task, "way": point.way, "level": point.level} | found)
    rows = by_point(measured + fixed_rows(asked))
    for way in dict.fromkeys(point.way for point in points()):
        done = sum(row["way"] == way for row in measured)
        asked.report(f"frontier: {way}: {done} of {sum(point.way == way for point in points()) * asked.seeds} rows")
    rows = beside_direct(rows)
    return Made(click_budgets(rows) + rows)


def by_point(measured: Rows) -> Rows:
    """Return means over the seeds of each task, way and level, with `seeds` and the standard error over them (None of one seed)."""

    def key(row: Row) -> tuple[str, str, float]:
        return row["task"], row["way"], row["level"]

    rows = []
    for (task, way, level), group in groupby(sorted(measured, key=key), key):
        found = list(group)
        values = [row["value"] for row in found]
        error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None
        facts: Row = {
            "table": task,
            "task": task,
            "way": way,
            "level": level,
            "seeds": len(found),
            "error_seeds": error,
        }
        rows.append(facts | {mean: statistics.fmean(row[mean] for row in found) for mean in MEANS})
    return sorted(rows, key=lambda row: (row["task"], row["way"], row["photons"]))


def error_of(row: Row) -> float:
    """Return the standard error of a point: from its seeds, where there are several, and from having few objects."""
    return math.hypot(row["error_seeds"] or 0.0, row["error_objects"])


def beside_direct(rows: Rows) -> Rows:
    """Return the points, those of other ways beside exact direct imaging and beside direct imaging that stops, at their own photons.

    Both errors count, as if the images were drawn for each: they are the same, so that the true error is smaller.
    """
    found = []
    for row in rows:
        for way, prefix in ((EXACT, ""), (STOPPING, "sure_")):
            curve = [
                other | {"error": error_of(other)}
                for other in rows
                if (other["task"], other["way"]) == (row["task"], way)
            ]
            there, error = (interpolated(curve, row["photons"], "photons", of) for of in ("value", "error"))
            if row["way"] not in (EXACT, STOPPING) and there is not None and error is not None:
                row = (
                    row | {f"{prefix}direct": there} | against(row["value"], there, error_of(row), error, prefix=prefix)
                )
        found.append(row)
    return found


def click_budgets(rows: Rows) -> Rows:
    """Return the paper's thirteen rows beside the automaton whose clicks on all images come nearest to the row's from below.

    It is chosen by clicks, not by accuracy. Of large automata of one level the one that was trained longest stands for all.
    """
    automata = [row for row in rows if row["way"] in BUDGETED]
    longest: dict[tuple[str, float], str] = {}
    for row in sorted((row for row in automata if row["way"] in LONGER), key=lambda row: LONGER.index(row["way"])):
        longest[row["task"], row["level"]] = row["way"]
    automata = [row for row in automata if row["way"] not in LONGER or row["way"] == longest[row["task"], row["level"]]]
    found = []
    for name, table in ACTIVE.items():
        for printed in table:
            line: Row = {"table": "budgets", "task": name, "features": printed.features, "paper": printed.simulation[0]}
            line |= {"paper_clicks": printed.clicks, "paper_illumination": printed.illumination}
            line["paper_photons"] = photons_at_least(printed.clicks, printed.features)
            below = [row for row in automata if row["task"] == name and row["clicks"] <= printed.clicks]
            if below:
                ours = max(below, key=lambda row: float(row["clicks"]))
                theirs = sampling_error(printed.simulation[0], FIRST_OBJECTS)
                line |= {key: ours[key] for key in ("way", "seeds", *MEANS)}
                line |= against(ours["value"], printed.simulation[0], error_of(ours), theirs)
            found.append(line)
    return found
