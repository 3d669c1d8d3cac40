"""The ways to decide that are measured for the frontier, their recipes, and the row of one of them.

Owns levels and recipes; each row is one task, way, level and seed, made once and kept in the cache folder under a name that says which,
with the recipe it was made by. Recipes here were chosen on the last 10 000 training images, none of them by test images. SIMULATED.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pans.trainer.baselines.common import silent
from pans.trainer.baselines.options import BaselineOptions
from pans.trainer.baselines.rows import baseline_rows
from pans.trainer.paper.page import Asked, Row, cached_row, kept
from pans.trainer.paper.paradigms import MEASURED
from pans.trainer.paper.tables import ACTIVE, FIRST
from pans.trainer.tasks.registry import Task

from .automata import automaton_recipe, automaton_row, bundle_path, made_so, train_unless_kept

TASKS = tuple(ACTIVE)
AUTOMATON, SMALL, HELD_TO_CLICKS = "automaton", "small automaton", "automaton, held to clicks"
ON = "automaton, trained on"
LARGER = "larger automaton"
LARGER_ON = (f"{LARGER}, trained on", f"{LARGER}, trained on twice")
EARLY = "small automaton, ends early"
FEW = {count: f"small automaton, {count} patterns" for count in (96, 1000)}
AUTOMATA = (AUTOMATON, ON, SMALL, HELD_TO_CLICKS, LARGER, *LARGER_ON)
LONGER = (AUTOMATON, ON, LARGER, *LARGER_ON)  # by how much training went into those of one level
TRAINED = (*AUTOMATA, EARLY, *FEW.values())  # the last are variations of the small one at its budgets
DIRECT, STOPPING = "direct, exact posterior", "direct, stops when sure"
MASKS, HADAMARD = "trained masks, counts", "Hadamard pairs, network"
# Sizes and epochs as long as one training has time for; budgets a little below the level, as test images may take more than others.
# Bundles of 500 objects per step, without soft targets, were trained before these and decisions had been tried.
EARLIER = (("batch", 500), ("soft", 0.0), ("decide", 0.0))
AUTOMATA_OF: dict[str, dict[float, tuple[tuple[str, float], ...]]] = {
    "fashion-mnist": {
        6.0: (("photons", 5.98), ("exposures", 40), ("states", 192), ("epochs", 7), *EARLIER),
        10.0: (("photons", 10.0), ("exposures", 48), ("states", 256), *EARLIER),
        17.0: (("photons", 16.75), ("exposures", 72), ("states", 320), ("epochs", 8)),
        40.0: (("photons", 39.2), ("exposures", 72), ("states", 208), ("epochs", 6)),
    },
    "mnist": {
        10.0: (("photons", 9.6), ("exposures", 44), ("states", 224), ("epochs", 7), *EARLIER),
        18.0: (("photons", 17.8), ("exposures", 72), ("states", 288), ("epochs", 7)),
        40.0: (("photons", 38.0), ("exposures", 96), ("states", 320), ("epochs", 6)),
    },
}
# The automaton of the same task, level and seed is trained on: docs/measurements/training.md, More and longer steps. Budgets as above.
AFTER = (("epochs", 8), ("rate", 0.03), ("reroutes", 4))
ON_OF: dict[str, dict[float, tuple[tuple[str, float], ...]]] = {
    "fashion-mnist": {40.0: (("photons", 39.0), *AFTER)},
    "mnist": {18.0: (("photons", 17.2), *AFTER), 40.0: (("photons", 38.0), *AFTER)},
}
# More exposures and more distortions, as large as the bundle's states allow: docs/measurements/training.md, Stronger distortions.
LARGER_OF: dict[str, dict[float, dict[str, tuple[tuple[str, float], ...]]]] = {
    "fashion-mnist": {
        40.0: {
            LARGER: (
                *(("photons", 37.5), ("exposures", 128), ("states", 320)),
                *(("epochs", 12), ("rate", 0.03), ("reroutes", 5), ("copies", 8), ("strength", 0.15)),
            ),
            LARGER_ON[0]: (
                *(("photons", 39.3), ("epochs", 12), ("rate", 0.03), ("reroutes", 6)),
                *(("copies", 8), ("strength", 0.15)),
            ),
        }
    },
    "mnist": {
        40.0: {
            LARGER: (
                *(("photons", 37.2), ("exposures", 128), ("states", 320)),
                *(("epochs", 12), ("rate", 0.03), ("reroutes", 5), ("strength", 0.6)),
            ),
            LARGER_ON[0]: (("photons", 37.9), ("epochs", 12), ("rate", 0.03), ("reroutes", 6), ("strength", 0.6)),
            LARGER_ON[1]: (("photons", 37.1), ("epochs", 14), ("rate", 0.03), ("reroutes", 6), ("strength", 0.6)),
        }
    },
}
CLICKS_OF = {"fashion-mnist": (1.281, 2.145), "mnist": (2.164,)}  # the automata above serve the larger ones
UNDER_CLICKS = 0.97  # of the paper's clicks is what training aims at, so that test images take no more
SMALL_PHOTONS = (4.0, 6.0, 10.0)
SMALL_SIZE = (("exposures", 24), ("states", 64))  # trained in about a minute of one core
EARLY_PRICE = (
    0.003  # nats per exposure; of 0.001, 0.003 and 0.01 on held-back training images (docs/how-to/automaton.md)
)
FEW_PHOTONS = {"fashion-mnist": (6.0,)}
DIRECT_PHOTONS = (2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 13.0, 17.0, 25.0, 40.0, 65.0, 100.0)
STOPPING_PHOTONS = (4.0, 6.0, 10.0, 17.0, 25.0, 40.0, 65.0, 100.0)
NETWORK_PHOTONS = (4.0, 10.0, 17.0, 40.0, 100.0)
MASKS_EPOCHS, HADAMARD_EPOCHS = 20, 10
# Masks by task and photons. On held-back training images the best of 8, 16, 24, 32 (FashionMNIST, 10 photons), 8, 16 (4), 16, 32 (40)
# and of 16, 32 (MNIST, 10) and 32, 64 (40); the others are those of the nearest level. Pairs hardly matter: of 4, 9, 16 at 10 photons,
# 16, 36 at 40 and 36, 64 at 100 (FashionMNIST) and 16, 36 at 10 (MNIST) all lie within 2.3 points.
MASKS_OF: dict[str, dict[float, int]] = {
    "fashion-mnist": {4.0: 16, 10.0: 16, 17.0: 16, 40.0: 32, 100.0: 32},
    "mnist": {4.0: 16, 10.0: 32, 17.0: 32, 40.0: 64, 100.0: 64},
}
PAIRS_OF: dict[str, dict[float, int]] = {
    "fashion-mnist": {4.0: 16, 10.0: 16, 17.0: 16, 40.0: 16, 100.0: 36},
    "mnist": {4.0: 16, 10.0: 16, 17.0: 16, 40.0: 36, 100.0: 64},
}


@dataclass(frozen=True, slots=True)
class Point:
    """One way at one level of one task: a budget of photons (of clicks, where held to them), and the recipe but for the seed.

    With `start` the automaton of that point and the same seed is trained on, by the next seed: other distortions in another order.
    """

    task: str
    way: str
    level: float
    recipe: tuple[tuple[str, Any], ...]
    start: Point | None = None

    @property
    def stem(self) -> str:
        """What its files in the cache are called, but for the seed."""
        words = self.way.replace(",", "").replace(" ", "-").lower()
        return f"frontier-{self.task}-{words}-{self.level:g}"

    def training_seed(self, seed: int) -> int:
        """Return the seed that the training of the row of that seed is given."""
        return seed if self.start is None else self.start.training_seed(seed) + 1

    def command(self, seed: int) -> str:
        """Return the command that measures the point alone; what it starts from is called as in the cache."""
        given = dict(self.recipe)
        if self.way in TRAINED:
            words = " ".join(f"--{key.replace('_', '-')} {value:g}" for key, value in given.items())
            words += "" if self.start is None else f" --start {bundle_path(Path(), self.start.stem, seed)}"
            words += f" --seed {self.training_seed(seed)}"
            return f"pans train {self.task} --encoder automaton --profile ideal {words} -o NAME.pans"
        options = {key: given[key] for key in ("method", "features", "epochs", "trials") if given[key] is not None}
        if given["paradigm"] == "direct":
            del options["features"]
        words = " ".join(f"--{key} {value}" for key, value in options.items())
        return f"pans baseline {given['paradigm']} --task {self.task} {words} --photons {self.level:g} --seed {seed}"


def points() -> Iterator[Point]:
    """Yield all points, in the order in which they are measured."""
    for name in TASKS:
        for photons in NETWORK_PHOTONS:
            masks = BaselineOptions("fsi", "deep", features=MASKS_OF[name][photons], epochs=MASKS_EPOCHS, trials=5)
            yield _baseline(name, MASKS, photons, masks)
            pairs = BaselineOptions(
                "hadamard", "counts", features=PAIRS_OF[name][photons], epochs=HADAMARD_EPOCHS, trials=5
            )
            yield _baseline(name, HADAMARD, photons, pairs)
        for photons in DIRECT_PHOTONS:
            yield _baseline(name, DIRECT, photons, BaselineOptions("direct", "bayes", trials=1))
    for name in TASKS:
        for photons in SMALL_PHOTONS:
            yield Point(name, SMALL, photons, (("photons", photons), *SMALL_SIZE))
    for name in TASKS:
        for photons, recipe in AUTOMATA_OF[name].items():
            yield Point(name, AUTOMATON, photons, recipe)
    for name in TASKS:
        for photons, recipe in ON_OF[name].items():
            yield Point(name, ON, photons, recipe, Point(name, AUTOMATON, photons, AUTOMATA_OF[name][photons]))
    for name, larger in LARGER_OF.items():
        for photons, recipes in larger.items():
            start = None
            for way, recipe in recipes.items():
                start = Point(name, way, photons, recipe, start)
                yield start
    for name in TASKS:
        for photons in STOPPING_PHOTONS:
            yield _baseline(name, STOPPING, photons, BaselineOptions("direct", "stopping", trials=1))
    for name in TASKS:
        for clicks in CLICKS_OF[name]:
            budget = (("clicks", round(UNDER_CLICKS * clicks, 3)), *SMALL_SIZE)
            yield Point(name, HELD_TO_CLICKS, clicks, budget)
    for name in TASKS:
        for photons in SMALL_PHOTONS:
            yield Point(name, EARLY, photons, (("photons", photons), *SMALL_SIZE, ("exposure_price", EARLY_PRICE)))
    for name, levels in FEW_PHOTONS.items():
        for photons in levels:
            for count, way in FEW.items():
                yield Point(name, way, photons, (("photons", photons), *SMALL_SIZE, ("patterns", count)))


def _baseline(task: str, way: str, photons: float, options: BaselineOptions) -> Point:
    return Point(task, way, photons, tuple(asdict(options).items()))


def row_of(asked: Asked, point: Point, seed: int, task: Task | None) -> Row | None:
    """Return the row of a point, from the cache or made now of `task`; None where it is not there and no task is given.

    Rows of stopping are made for all its levels at once: they are read off the same photons. None for a level that it cannot reach.
    """
    if point.way == STOPPING:
        return _stopping_row(asked, point, seed, task)
    path = asked.cache / f"{point.stem}-seed{seed}.json"
    make = dict if task is None else partial(_made, asked, point, seed, task)
    found = kept(path, _recipe_kept(path, point, seed), make, collect=task is None)
    return None if found is None else _plain(found, point, seed)


def made_with(point: Point, seed: int) -> Row:
    """Return the whole recipe of a row, defaults spelt out: one that was made with another is made again."""
    options = dict(point.recipe)
    if point.way in TRAINED:
        options = asdict(automaton_recipe(point.task, options, point.training_seed(seed)))
        if point.start is not None:
            begun = made_with(point.start, seed)
            options |= {"start": begun, "exposures": begun["exposures"], "states": begun["states"]}
    return {**options, "way": point.way, "seed": seed}


def _recipe_kept(path: Path, point: Point, seed: int) -> Row:
    """Return the recipe of a row; that of an automaton as it stands in the cache, if the same but for options newer than it."""
    wanted = json.loads(json.dumps(made_with(point, seed)))
    found = cached_row(path, "made_with") if point.way in TRAINED else None
    return found["made_with"] if found is not None and made_so(wanted, found["made_with"]) else wanted


def beyond_reach(asked: Asked, point: Point, seed: int) -> bool:
    """Return whether stopping was measured with that seed and does not take as many photons as the level of `point`."""
    levels = _stopping_levels(asked, point, seed, None) if point.way == STOPPING else None
    return levels is not None and f"{point.level:g}" not in levels


def _stopping_row(asked: Asked, point: Point, seed: int, task: Task | None) -> Row | None:
    row = (_stopping_levels(asked, point, seed, task) or {}).get(f"{point.level:g}")
    return None if row is None else _plain(row, point, seed)


def _stopping_levels(asked: Asked, point: Point, seed: int, task: Task | None) -> Row | None:
    """Return the rows of all levels of a seed by level, those out of reach left out; None where they are not there and no task is given."""
    path = asked.cache / f"frontier-{point.task}-stopping-seed{seed}.json"

    def make() -> Row:
        assert task is not None
        asked.report(f"frontier: {point.task}, {point.way}, all levels, seed {seed}")
        rows = baseline_rows(task, _options(point, seed), STOPPING_PHOTONS, silent)
        return {"rows": {f"{row['photons_asked']:g}": row for row in rows}}

    whole = {**made_with(point, seed), "levels": STOPPING_PHOTONS}
    found = kept(path, whole, make, collect=task is None)
    return None if found is None else dict(found["rows"])


def _options(point: Point, seed: int) -> BaselineOptions:
    return BaselineOptions(**(dict(point.recipe) | {"seed": seed}))


def _made(asked: Asked, point: Point, seed: int, task: Task) -> Row:
    asked.report(f"frontier: {point.task}, {point.way}, {point.level:g}, seed {seed}")
    if point.way in TRAINED:
        start = None if point.start is None else _bundle_of(asked, point.start, seed, task)
        path = bundle_path(asked.cache, point.stem, seed)
        return automaton_row(asked, path, task, dict(point.recipe), point.training_seed(seed), start)
    return next(iter(baseline_rows(task, _options(point, seed), [point.level], silent)))


def _bundle_of(asked: Asked, point: Point, seed: int, task: Task) -> Path:
    """Return where the automaton of a point lies, trained now unless it is there; before it, what it goes on from."""
    start = None if point.start is None else _bundle_of(asked, point.start, seed, task)
    path = bundle_path(asked.cache, point.stem, seed)
    train_unless_kept(asked, path, task, dict(point.recipe), point.training_seed(seed), start)
    return path


def _plain(found: Row, point: Point, seed: int) -> Row:
    """Return what the page keeps of a row."""
    whole = found.get("all", found)
    facts: Row = {
        key: found[key] for key in ("sha256", "floor", "confidence", "states", "patterns_shown") if key in found
    }
    return {
        "task": point.task,
        "way": point.way,
        "level": point.level,
        "seed": seed,
        "command": point.command(seed),
        "exposures": found["exposures"] if "exposures" in found else _exposures(point),
        "cpu_seconds": found.get("training_seconds", found.get("cpu_seconds", found.get("seconds"))),
        "all": {key: whole[key] for key in MEASURED if key in whole},
        FIRST: {key: found[FIRST][key] for key in MEASURED if key in found[FIRST]},
        **facts,
    }


def _exposures(point: Point) -> int:
    """Exposures of a baseline: one frame; one per mask; two per pair."""
    options = dict(point.recipe)
    return {"fsi": 1, "hadamard": 2}.get(options["paradigm"], 0) * options["features"] or 1
