"""Ways to measure and decide, at levels of light (ways.toml): baselines, fixed patterns and automata, from several seeds.

A point is one way at one level of one task. Finished figures and bundles stay in the cache folder.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pans.bundle.sensor import load_bundle
from pans.instrument.profile import load_profile
from pans_trainer.baselines.common import Light, silent
from pans_trainer.baselines.rows import baseline_rows
from pans_trainer.evaluate.accuracy import row_of
from pans_trainer.options import AutomatonOptions, BaselineOptions, Options
from pans_trainer.tasks.registry import Task, load_task
from pans_trainer.train.automaton.budget import for_task, started_from, with_defaults

from .active import PROFILE
from .page import FIRST_OBJECTS, Asked, Row, Rows, check_cached_bundle, flat, read_toml

WAYS: list[Row] = read_toml("ways.toml")["way"]
OF_TASKS = "of each task"
SENT = " sent"  # of a level in ways.toml: light sent, not photons detected
BY_SENT = ", sent"  # of the way's name in a row
START_AT = "start_at"  # the level of the automaton that it starts from, where that is another


@dataclass(frozen=True, slots=True)
class Point:
    """One way at one level of one task: the kind of recipe, its options but for the seed, and all levels that share them."""

    task: str
    way: str
    level: float
    kind: str
    options: tuple[tuple[str, Any], ...]
    levels: tuple[float, ...] = ()
    start: Point | None = None
    sent: tuple[float, ...] = ()  # levels of light sent that share the options
    by_sent: bool = False  # whether `level` is of light sent

    @property
    def named(self) -> str:
        """What its way is called in a row."""
        return self.way + (BY_SENT if self.by_sent else "")

    @property
    def stem(self) -> str:
        """What its files in the cache are called, but for the seed."""
        words = "".join(letter for letter in self.way.lower().replace(" ", "-") if letter.isalnum() or letter == "-")
        return f"frontier-{self.task}-{words}-{'sent-' if self.by_sent else ''}{self.level:g}"

    def training_seed(self, seed: int) -> int:
        """Return the seed of the training: the next one after that of the automaton it starts from, for other distortions."""
        return seed if self.start is None else self.start.training_seed(seed) + 1

    def made_with(self, seed: int) -> Row:
        """Return the whole recipe of a row: one that was made with another is made again."""
        start = {} if self.start is None else {"start": self.start.made_with(seed)}
        sent = {"sent": self.sent} if self.sent else {}
        return {"kind": self.kind, **dict(self.options), "seed": self.training_seed(seed), **start, **sent}


def ways_of(page: str) -> list[str]:
    """Return the names of the ways of a page."""
    return [way["name"] for way in _of_page(page)]


def _of_page(page: str) -> Rows:
    """Return the ways of a page; those of `OF_TASKS` stand on the page of each of their tasks, with its levels alone."""
    own = [way for way in WAYS if way.get("page", "frontier") == page]
    shared = [way for way in WAYS if way.get("page") == OF_TASKS and page in way["levels"]]
    return own + [way | {"levels": {page: way["levels"][page]}} for way in shared]


def points(page: str) -> Iterator[Point]:
    """Yield all points of a page, way by way."""
    known: dict[tuple[str, str, str], Point] = {}
    for way in _of_page(page):
        for task, levels in way["levels"].items():
            for text, more in levels.items():
                start = known[task, way["start"], more.get(START_AT, text)] if "start" in way else None
                shared: dict[bool, list[float]] = {False: [], True: []}
                for other in (other for other, options in levels.items() if options == more):
                    shared[other.endswith(SENT)].append(float(other.removesuffix(SENT)))
                level, options = float(text.removesuffix(SENT)), way["options"] | more
                options.pop(START_AT, None)
                alike = tuple(shared[False]), start, tuple(shared[True])
                point = Point(
                    task, way["name"], level, way["kind"], tuple(options.items()), *alike, text.endswith(SENT)
                )
                known[task, way["name"], text] = point
    yield from known.values()


def measured_points(asked: Asked, page: str, seeds: int = 1) -> Rows:
    """Return one row per wanted point and seed that is finished, or measured now: one seed of everything comes before the next."""
    rows: Rows = []
    for seed in range(seeds):
        for point in points(page):
            if asked.ways is not None and point.way not in asked.ways:
                continue
            features = dict(point.options).get("features")
            if features is not None and not asked.wants(features):
                continue
            found = point_row(asked, point, seed)
            if found is not None:
                rows.append({"task": point.task, "way": point.named, "level": point.level} | found)
    return rows


def best_of(rows: Rows, way: str) -> Rows:
    """Return the best of all rows at each level, as rows of the way `way`; chosen by all test objects."""
    levels = sorted({row["level"] for row in rows})
    best = [max((r for r in rows if r["level"] == n), key=lambda r: float(r["value"])) for n in levels]
    return [row | {"way": way} for row in best]


def point_row(asked: Asked, point: Point, seed: int) -> Row | None:
    """Return the flat figures of a point from one seed, from the cache or measured now; None where it is missing or out of reach."""
    made_with = point.made_with(seed)
    if point.kind == "baseline":  # all levels of the same options at once: they share what is trained or drawn
        first = replace(point, level=(point.levels or point.sent)[0], by_sent=not point.levels)
        made_with |= {"levels": point.levels}
        found = asked.kept(f"{first.stem}-seed{seed}", made_with, partial(_baseline, asked, point, seed))
        return None if found is None else found["rows"].get(_key(point.level, point.by_sent))
    make = partial({"fixed": _fixed, "automaton": _automaton}[point.kind], asked, point, seed)
    return asked.kept(f"{point.stem}-seed{seed}", made_with, make)


def _key(level: float, by_sent: bool) -> str:
    return f"{level:g}{SENT if by_sent else ''}"


@functools.lru_cache(maxsize=1)  # the points of a task share it
def _task(name: str, data_dir: str | None) -> Task:
    return load_task(name, data_dir)


def _baseline(asked: Asked, point: Point, seed: int) -> Row:
    options = BaselineOptions(**dict(point.options), seed=seed)
    per_feature = {"fsi": 1, "hadamard": 2}.get(options.paradigm, 0)  # one per mask, two per pair, one frame
    exposures = per_feature * options.features or 1
    facts = {"exposures": exposures, "features": options.features}
    levels = [Light("photons", level) for level in point.levels]
    levels += [Light("illumination", level) for level in point.sent]
    found: dict[str, Row] = {}
    for row in baseline_rows(_task(point.task, asked.data_dir), options, levels, silent):
        by_sent = row["photons_asked"] is None
        level = row["illumination_asked" if by_sent else "photons_asked"]
        found[_key(level, by_sent)] = flat(row, row["first_200"]) | facts
    return {"rows": found}


def _fixed(asked: Asked, point: Point, seed: int) -> Row:
    from pans_trainer.train.gradient.loop import train

    from .passive import measure

    task, options = _task(point.task, asked.data_dir), Options(**dict(point.options), seed=seed)
    return measure(point.task, task, train(task, load_profile(PROFILE), options)) | {"exposures": options.features}


def _automaton(asked: Asked, point: Point, seed: int) -> Row:
    from pans_trainer.export.automaton import measure_walks

    task, profile = _task(point.task, asked.data_dir), load_profile(PROFILE)
    bundle, _ = load_bundle(trained_automaton(asked, point, seed))
    whole, first = (row_of(measure_walks(bundle, task.test.first(count), profile)) for count in (None, FIRST_OBJECTS))
    return flat(whole, first) | {"exposures": whole["exposures_mean"]}


def trained_automaton(asked: Asked, point: Point, seed: int) -> Path:
    """Return where the automaton of a point is, trained now unless one of the same recipe is there; the one it starts from comes first."""
    from pans_trainer.device import keep_freed_memory
    from pans_trainer.export.automaton import export_automaton
    from pans_trainer.train.automaton.train import train_automaton
    from pans_trainer.train.automaton.tune import Progress

    path = asked.cache / f"{point.stem}-seed{seed}.pans"
    task, profile = _task(point.task, asked.data_dir), load_profile(PROFILE)
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

    def report(at: Progress) -> None:
        if at.done % 8 == 0:
            asked.report(f"{path.stem}: {at.stage}, {at.done} of {at.steps}")

    trained = train_automaton(
        task,
        profile,
        options,
        checkpoint=checkpoint,
        resume=checkpoint.is_file(),
        report=report,
        teacher=asked.cache / f"frontier-{task.name}-soft-targets.npz",  # of all seeds
        start=None if start is None else start[0],
    )
    provenance = {"command": "pans reproduce frontier", "options": asdict(options)}
    export_automaton(path, trained, task, profile, name=path.stem, provenance=provenance, force=True)
    checkpoint.unlink(missing_ok=True)
    return path
