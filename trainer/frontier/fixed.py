"""Fixed patterns on the frontier: the paper's, and ours of other pages, which are not measured again.

Owns the reading of NAME.json of the pages `fashion-mnist`, `mnist` (held to clicks), `alpha` (a weight on the light) and `equal-photons`
(held to photons, or to illumination) beside the page that is written, and of the paper's printed figures. The bound on the paper's photons
is `photons_at_least`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from pans.runtime.errors import UsageError
from pans.trainer.paper.equal import HELD, SENT
from pans.trainer.paper.page import Row, Rows, read_rows
from pans.trainer.paper.tables import ACTIVE, FIRST, FIRST_OBJECTS

PAPER, FIXED, FIXED_LIGHT = "paper, fixed patterns", "ours, fixed, held to clicks", "ours, fixed, light weighed"
FIXED_BUDGET, FIXED_SENT = "ours, fixed, held to photons", "ours, fixed, held to illumination"
EQUAL = {HELD: FIXED_BUDGET, SENT: FIXED_SENT}  # by the way on the page `equal-photons`


def photons_at_least(clicks: float, features: int) -> float:
    """Return the least photoelectrons of that many clicks of so many thresholded exposures: -d_f ln(1 - clicks / d_f).

    The mean of lambda over exposures is least, for a given mean of 1 - exp(-lambda), where all are equal (Jensen).

    >>> round(photons_at_least(4.939, 10), 2)
    6.81
    """
    if not 0 <= clicks < features:
        raise ValueError(f"{clicks:g} clicks of {features} exposures, allowed: below {features}, at least 0")
    return -features * math.log1p(-clicks / features)


def paper_rows() -> Iterator[Row]:
    """Yield the paper's simulation at one shot, on its 200 images: photons are a bound."""
    for name, printed in ACTIVE.items():
        for row in printed:
            figures = {
                "accuracy_mean": row.simulation[0] / 100,
                "accuracy_std": row.simulation_std[0] / 100,
                "clicks_mean": row.clicks,
                "photons_mean": photons_at_least(row.clicks, row.features),
                "illumination": row.illumination,
                "objects": FIRST_OBJECTS,
            }
            facts = {"task": name, "way": PAPER, "level": float(row.features), "seed": 0, "exposures": row.features}
            yield {**facts, "bound": True, FIRST: figures}


def fixed_rows(results: Path | None) -> Rows:
    """Return the rows of our fixed patterns from the pages in the folder `results`; none of a page that is not there."""
    rows: Rows = []
    if results is None:
        return rows
    for name in ACTIVE:
        for found in _page(results, name):
            for one in (found, *found.get("other_seeds", ())):
                facts = {"task": name, "way": FIXED, "level": float(found["features"]), "seed": one["options"]["seed"]}
                shots = {"exposures": found["features"], "all": one["all"]["1"], FIRST: one[FIRST]["1"]}
                rows.append({**facts, **shots, "cpu_seconds": one["cpu_seconds"]})
    for found in _page(results, "alpha"):
        if found["alpha"] > 0 and found["features"] == 32:
            facts = {"task": "fashion-mnist", "way": FIXED_LIGHT, "level": found["alpha"], "seed": 0}
            rows.append(
                {**facts, "exposures": found["features"], **_final(found["final"]), "cpu_seconds": found["cpu_seconds"]}
            )
    for found in _page(results, "equal-photons"):
        if found["task"] in ACTIVE and found["way"] in EQUAL:
            asked = found["options"]
            facts = {"task": found["task"], "way": EQUAL[found["way"]], "level": found["asked"], "seed": asked["seed"]}
            facts |= {"exposures": asked["features"], "cpu_seconds": found["cpu_seconds"]}
            rows.append({**facts, **_final(found)})
    return rows


def _final(final: Row) -> Row:
    """The figures of a row of `alpha`, in % there, as those of the other pages."""
    whole = {
        "accuracy_mean": final["value"] / 100,
        "accuracy_std": final["spread_trials"] / 100,
        "accuracy_se_objects": final["error_objects"] / 100,
        "clicks_mean": final["clicks"],
        "photons_mean": final["photons"],
        "illumination": final["illumination"],
        "objects": final["objects"],
    }
    return {"all": whole, FIRST: {"accuracy_mean": final[FIRST] / 100, "objects": FIRST_OBJECTS}}


def _page(results: Path, name: str) -> Rows:
    if not (results / f"{name}.json").is_file():
        return []
    try:
        return read_rows(results, name)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{results / name}.json is no page of results", remedy="write it again, or remove it"
        ) from error
