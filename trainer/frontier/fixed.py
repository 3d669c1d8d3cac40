"""Fixed patterns on the frontier: the paper's, ours of other pages, which are not measured again, and ours held to photons.

Owns the training of the last, the reading of NAME.json of the pages `fashion-mnist`, `mnist` (held to clicks) and `alpha` (a weight on the
light) beside the page that is written, and of the paper's printed figures. The bound on the paper's photons is `photons_at_least`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

from pans.runtime.bundle.model import load_bundle
from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import load_profile
from pans.trainer.evaluate.accuracy import evaluate_sampled, light_of
from pans.trainer.options import Options, plain_options
from pans.trainer.paper.active import PROFILE, parts_of
from pans.trainer.paper.page import Asked, Row, Rows, check_cached_bundle, read_rows
from pans.trainer.paper.tables import ACTIVE, FIRST, FIRST_OBJECTS
from pans.trainer.tasks.registry import Task

PAPER, FIXED, FIXED_LIGHT = "paper, fixed patterns", "ours, fixed, held to clicks", "ours, fixed, light weighed"
FIXED_BUDGET = "ours, fixed, held to photons"
TRIALS = {FIRST: 100, "all": 10}


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


def budget_row(asked: Asked, path: Path, task: Task, photons: float, features: int, seed: int) -> Row:
    """Train fixed patterns that may take that many photons on average, write their bundle to `path` in the cache, and measure them."""
    from pans.trainer.export.writer import export_trained
    from pans.trainer.train.loop import train

    check_cached_bundle(path)
    options, profile = budget_recipe(photons, features, seed), load_profile(PROFILE)
    checkpoint, started = path.with_suffix(".checkpoint"), time.process_time()
    trained = train(task, profile, options, checkpoint=checkpoint, resume=checkpoint.is_file())
    provenance = {"command": "pans reproduce frontier", "options": plain_options(options)}
    exported = export_trained(path, trained, task, profile, name=path.stem, provenance=provenance, force=True)
    checkpoint.unlink(missing_ok=True)
    asked.report(f"{path.stem}: trained")
    facts = {"sha256": exported.sha256, "exposures": features, "training_seconds": time.process_time() - started}
    bundle, found = load_bundle(path)[0], {}
    for part, objects in parts_of(task.test).items():
        drawn = light_of(bundle, profile, objects.images)
        measured = evaluate_sampled(bundle, drawn, objects.labels, shots=1, trials=TRIALS[part], seed=1)
        found[part] = asdict(measured)
    return facts | found


def budget_recipe(photons: float, features: int, seed: int) -> Options:
    """Return the schedule that `equal-photons` trains 32 patterns and more with, for a budget of light alone."""
    shared = Options(features=features, alpha=0.0, photons=0.97 * photons, estimator="local", seed=seed)
    return replace(shared, epochs=44, warm=0.4, hidden=256, head_rate=3e-3)


def _page(results: Path, name: str) -> Rows:
    if not (results / f"{name}.json").is_file():
        return []
    try:
        return read_rows(results, name)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{results / name}.json is no page of results", remedy="write it again, or remove it"
        ) from error
