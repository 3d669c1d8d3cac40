"""The paper's figures (printed.toml) as rows, and the recipes of our trainings (recipes.toml) as options."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pans_trainer.options import Options

from .page import Row, read_toml

SHOTS = (1, 2, 3, 5)


@dataclass(frozen=True, slots=True)
class ActiveRow:
    """Accuracy in % and the spread of one trial at 1, 2, 3 and 5 shots, simulation and experiment; clicks and illumination of one shot."""

    features: int
    clicks: float
    illumination: float
    simulation: tuple[float, ...]
    simulation_std: tuple[float, ...]
    experiment: tuple[float, ...]
    experiment_std: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PassiveRow:
    """The measure at the table's dark counts, one shot; clicks at the first of them. No values: the paper prints none."""

    features: int
    values: tuple[float, ...]
    clicks: float


@dataclass(frozen=True, slots=True)
class PassiveTable:
    """A table over patterns and dark counts per detector; `measure` is "accuracy" in %, or "SSIM"."""

    measure: str
    dark: tuple[float, ...]
    objects: int
    rows: tuple[PassiveRow, ...]


def _active(line: Sequence[Any]) -> ActiveRow:
    features, clicks, illumination, *columns = line
    return ActiveRow(features, clicks, illumination, *map(tuple, columns))


def _passive(table: Row) -> PassiveTable:
    rows = tuple(PassiveRow(line[0], tuple(line[1:-1]), line[-1]) for line in table["rows"])
    return PassiveTable(table["measure"], tuple(table["dark"]), table["objects"], rows)


_PRINTED, _RECIPES = read_toml("printed.toml"), read_toml("recipes.toml")
ACTIVE = {name: tuple(map(_active, lines)) for name, lines in _PRINTED["active"].items()}
PASSIVE = {name: _passive(table) for name, table in _PRINTED["passive"].items()}
# Direct imaging by the exact posterior, all 10 000 test images: photons, accuracy, its standard error from having few objects.
DIRECT: dict[str, list[Row]] = {
    name: [dict(zip(("photons", "value", "error_objects"), point)) for point in points]
    for name, points in _PRINTED["direct"].items()
}


def recipe_facts(name: str) -> Row:
    """Return the entry of recipes.toml of that name."""
    facts: Row = _RECIPES[name]
    return facts


def recipe(name: str, row: ActiveRow | PassiveRow, dark: float | None = None) -> Options:
    """Return the options of one training: those of its entry, then of each of the entry's sizes that holds the row.

    Clicks are `clicks_times` the paper's. With `same_light` dark counts above the table's first add their clicks to the budget.
    """
    facts = recipe_facts(name)
    given = dict(facts["options"])
    for size in facts.get("sizes", ()):
        if size.get("from", 1) <= row.features <= size.get("to", math.inf):
            given |= {key: value for key, value in size.items() if key not in ("from", "to")}
    times = given.pop("clicks_times", None)
    if times is not None:
        given["clicks"] = times * row.clicks
        if facts.get("same_light") and isinstance(row, PassiveRow) and row.values:
            given["clicks"] += (row.features - row.clicks) * -math.expm1(
                min(0.0, PASSIVE[name].dark[0] - (dark or 0.0))
            )
    if dark is not None:
        given["dark"] = dark
    return Options(features=row.features, **given)
