"""The paper's figures: what it reports for every table that is reproduced here.

Owns the reading of tables.toml, where the numbers and their meaning are, into rows; a malformed file is a ValueError. Accuracies and
SSIM are as printed; `clicks` is what the paper prints as N_det, the mean number of binary readouts.
"""

from __future__ import annotations

import importlib.resources
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

SHOTS = (1, 2, 3, 5)
FIRST_OBJECTS = 200  # test images, by which the paper judges the active tables
FIRST = f"first_{FIRST_OBJECTS}"  # the key of a row's figures of these images
CLICKS_TOLERANCE = 1.05  # a row counts at no more than this times the paper's clicks


@dataclass(frozen=True, slots=True)
class ActiveRow:
    """Accuracy in % and the spread of one trial at 1, 2, 3 and 5 shots, simulation and experiment; clicks and illumination of one shot."""

    features: int
    simulation: tuple[float, ...]
    experiment: tuple[float, ...]
    clicks: float
    illumination: float
    simulation_std: tuple[float, ...] = (0.0,) * len(SHOTS)
    experiment_std: tuple[float, ...] = (0.0,) * len(SHOTS)


@dataclass(frozen=True, slots=True)
class PassiveRow:
    """The measure at the table's dark counts, one shot; clicks at the first of them. No values: the paper prints none."""

    features: int
    values: tuple[float, ...]
    clicks: float


@dataclass(frozen=True, slots=True)
class PassiveTable:
    """A table over patterns and dark counts per detector."""

    measure: str  # "accuracy" in %, or "SSIM"
    dark: tuple[float, ...]
    rows: tuple[PassiveRow, ...]
    objects: int


def _active(name: str, line: Sequence[Any]) -> ActiveRow:
    features, clicks, illumination, *columns = line
    if len(columns) != 4 or any(len(column) != len(SHOTS) for column in columns):
        raise ValueError(
            f"tables.toml: {name}, d_f = {features}: 4 columns of {len(SHOTS)} numbers are wanted, found {columns}"
        )
    simulation, simulation_std, experiment, experiment_std = map(tuple, columns)
    return ActiveRow(features, simulation, experiment, clicks, illumination, simulation_std, experiment_std)


def _passive(name: str, table: dict[str, Any], printed: bool) -> PassiveTable:
    values = len(table["dark"]) if printed else 0
    for line in table["rows"]:
        if len(line) != values + 2:
            raise ValueError(
                f"tables.toml: {name}, d_f = {line[0]}: {values} values and the clicks are wanted, found {line[1:]}"
            )
    rows = tuple(PassiveRow(line[0], tuple(line[1:-1]), line[-1]) for line in table["rows"])
    return PassiveTable(table["measure"], tuple(table["dark"]), rows, table["objects"])


_FILE: dict[str, Any] = tomllib.loads(
    (importlib.resources.files(__package__) / "tables.toml").read_text(encoding="utf-8")
)

ACTIVE = {name: tuple(_active(name, line) for line in lines) for name, lines in _FILE["active"].items()}
PASSIVE = {name: _passive(name, table, printed=True) for name, table in _FILE["printed"].items()}
UNPRINTED = {name: _passive(name, table, printed=False) for name, table in _FILE["unprinted"].items()}
DIRECT: dict[str, dict[float, float]] = {
    name: {photons: accuracy for photons, accuracy, _ in points} for name, points in _FILE["direct"].items()
}
DIRECT_ERRORS: dict[str, dict[float, float]] = {
    name: {photons: error for photons, _, error in points} for name, points in _FILE["direct"].items()
}


def table_of(name: str) -> PassiveTable:
    """Return the table of a task other than the active ones, with or without printed figures."""
    return PASSIVE.get(name) or UNPRINTED[name]
