"""Accuracy under given optics: over draws within a tolerance, at its edge, and against each misalignment by itself. SIMULATED."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pans.base.numbers import demand
from pans.bundle.sensor import Bundle
from pans.instrument.optics import Imaging, Tolerance
from pans_trainer.options import Conditions

from .accuracy import AS_IT_IS, Measured
from .held_out import HeldOut, measure, trials_needed
from .walks import MeasuredWalks

CURVES: Mapping[str, tuple[float, ...]] = {
    "shift_px": (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0),  # to the right and down alike
    "rotation_deg": (0.0, 1.0, 2.0, 3.0, 5.0),
    "psf_px": (0.0, 0.3, 0.5, 0.7, 0.9, 1.2),
    "black": (0.0, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02),
}
DRAW_STREAM = 0xD7A  # with the seed
TABLES_MAX = 100_000
SHOWN = ("accuracy_mean", "accuracy_se_objects", "clicks_mean", "photons_mean", "illumination")  # of a point
Figures = Measured | MeasuredWalks
Report = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class OverOptics:
    """Means over several tables. `accuracy_std_optics` is the spread from table to table, `accuracy_se_objects` the error of one table's
    figure that comes from having few objects (the tables share them)."""

    accuracy_mean: float
    accuracy_std_optics: float
    accuracy_se_optics: float
    accuracy_se_objects: float
    accuracy_worst: float
    clicks_mean: float
    photons_mean: float
    illumination: float
    objects: int
    tables: int


def figures_under(bundle: Bundle, held_out: HeldOut, imaging: Imaging, conditions: Conditions) -> Figures:
    """Return what `bundle` decides when objects stand as `imaging` says; ValueError for bundles that return pictures."""
    if bundle.picture_shape is not None:
        raise ValueError(f"{bundle.name} returns pictures, allowed: bundles that decide among classes")
    shifted = replace(conditions, imaging=imaging)
    found = measure(bundle, held_out, trials=trials_needed(bundle), conditions=shifted)
    assert isinstance(found, (Measured, MeasuredWalks))
    return found


def over_optics(
    bundle: Bundle,
    held_out: HeldOut,
    tables: Iterable[Imaging],
    conditions: Conditions = AS_IT_IS,
    report: Report = lambda done, of: None,
) -> OverOptics:
    """Return the means over `tables`, at least one; `report` gets how many are done."""
    which, found = list(tables), []
    for imaging in which:
        found.append(figures_under(bundle, held_out, imaging, conditions))
        report(len(found), len(which))
    right = np.array([one.accuracy_mean or 0.0 for one in found])
    spread = float(right.std(ddof=1)) if len(right) > 1 else 0.0
    return OverOptics(
        accuracy_mean=float(right.mean()),
        accuracy_std_optics=spread,
        accuracy_se_optics=spread / math.sqrt(len(right)),
        accuracy_se_objects=float(np.mean([one.accuracy_se_objects or 0.0 for one in found])),
        accuracy_worst=float(right.min()),
        clicks_mean=float(np.mean([one.clicks_mean for one in found])),
        photons_mean=float(np.mean([one.photons_mean for one in found])),
        illumination=float(np.mean([one.illumination for one in found])),
        objects=found[0].objects,
        tables=len(which),
    )


def drawn_tables(tolerance: Tolerance, count: int, seed: int) -> list[Imaging]:
    """Return `count` optics drawn within `tolerance`."""
    random = np.random.default_rng([DRAW_STREAM, seed])
    return [tolerance.draw(random) for _ in range(count)]


def whole_shifts(tolerance: Tolerance) -> list[Imaging]:
    """Return the optics with every shift by whole pixels within `tolerance`; ValueError where more than the shift may vary."""
    about = replace(tolerance.middle, right_px=0.0, down_px=0.0)
    right, down = (range(math.ceil(low), math.floor(high) + 1) for low, high in (tolerance.right_px, tolerance.down_px))
    free = [
        name for name, (low, high) in tolerance.as_dict().items() if low < high and name not in ("right_px", "down_px")
    ]
    demand(not free, f"whole shifts with a span of {', '.join(free)}, allowed: one value of all but the shift")
    count = len(right) * len(down)
    demand(0 < count <= TABLES_MAX, f"{count} shifts by whole pixels, allowed: 1 to {TABLES_MAX}")
    return [replace(about, right_px=float(x), down_px=float(y)) for y in down for x in right]


def misalignment_curves(
    bundle: Bundle,
    held_out: HeldOut,
    about: Imaging,
    conditions: Conditions = AS_IT_IS,
    report: Report = lambda done, of: None,
) -> dict[str, list[dict[str, Any]]]:
    """Return for every curve of `CURVES` its points, one misalignment at a time about the optics `about`.

    A point holds `value`, and of the figures what `pans evaluate` reports of light and accuracy.
    """
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in CURVES}
    every = [(name, value) for name, values in CURVES.items() for value in values]
    for done, (name, value) in enumerate(every, start=1):
        measured = asdict(figures_under(bundle, held_out, _off(about, name, value), conditions))
        found[name].append({"value": value, **{key: measured[key] for key in SHOWN}})
        report(done, len(every))
    return found


def _off(about: Imaging, name: str, value: float) -> Imaging:
    if name == "shift_px":
        return replace(about, right_px=about.right_px + value, down_px=about.down_px + value)
    if name == "rotation_deg":
        return replace(about, rotation_deg=about.rotation_deg + value)
    fact: dict[str, Any] = {name: value}
    return replace(about, **fact)
