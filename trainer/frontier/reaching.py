"""The page `reaching`: passive sensing beside direct imaging with the light that must reach the optics.

Owns the choice of the direct ways for each scene, the levels of light of encoders that conserve it, and the tables. The rows of PANS are
those of the passive pages (paper/passive.py) at their first dark count, with W unconstrained as in the paper, and of encoders held to
conserve light (paper/equal.py). Beside each stands direct imaging with as many photons as must reach the optics of PANS at least, decided
by the better of two ways, judged on the same held-out objects. Direct imaging has no dark counts here, and gets no more than
`PHOTONS_MAX`, which only favours PANS. SIMULATED, on the profile `ideal`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from pans.trainer.baselines.bayes import bayes
from pans.trainer.baselines.common import Decide, Measurement
from pans.trainer.baselines.common import measure as measure_frames
from pans.trainer.baselines.networks import aware_cnn
from pans.trainer.baselines.statistics import matched_decision, pairs_decision
from pans.trainer.paper.equal import (
    EQUAL_LIGHT,
    FLOOR,
    INCOHERENT,
    NETWORK_EPOCHS_ELSE,
    direct_figures,
    equal_row,
)
from pans.trainer.paper.page import Asked, Draw, Made, Row, Rows, Table, columns, kept
from pans.trainer.paper.passive import finished_cell, make_cell
from pans.trainer.paper.tables import table_of
from pans.trainer.tasks.registry import load_task
from pans.trainer.verdicts import against, claim

from . import plots

POSTERIOR, NETWORK, MATCHED, PAIRS = "posterior", "network", "matched filter", "photon pairs"
WAYS = {  # to decide frames: what suits the scene, and the posterior, which is strong at few photons
    "transient": (MATCHED, POSTERIOR),
    "fiber": (PAIRS, POSTERIOR),
    "nebula": (NETWORK, POSTERIOR),
    "tissue": (PAIRS, POSTERIOR),
}
LIGHT = (25.0, 100.0, 1000.0, 10_000.0)  # photons that reach the optics of an encoder that conserves light
NEAR = 1.02  # held-out objects give up to 2 % more or less light than those that an encoder was fitted to
# Of direct imaging. A network is trained for each level; the posterior is a nearest neighbour from there on; more than a million photons
# would tell nothing more.
PHOTONS_MAX = {NETWORK: 1e4, POSTERIOR: 1e4, MATCHED: 1e6, PAIRS: 1e6}
UNCONSTRAINED, CONSERVING, MASK = "unconstrained", "conserving", "of intensities, conserving"
MASKED = ("nebula", "tissue")  # in truth incoherent light (the notes of the tasks): masks before bucket detectors too


def reaching_page(asked: Asked) -> Made:
    """Return one row per task and encoder, with the figures of direct imaging at its light in `direct`."""
    rows = []
    for name in WAYS:
        for row in (*_unconstrained(asked, name), *_conserving(asked, name)):
            direct = [_direct(asked, name, way, _light(way, row["reaching"])) for way in WAYS[name]]
            done = [found for found in direct if found is not None]
            if len(done) == len(direct):
                rows.append(row | {"direct": max(done, key=lambda found: float(found["value"]))})
    pictures: dict[str, Draw] = {"": partial(plots.reaching, rows=rows)}
    return Made(rows, pictures)


def _unconstrained(asked: Asked, name: str) -> Rows:
    found, table = [], table_of(name)
    for row in table.rows:
        if asked.wants(row.features):
            figures = finished_cell(asked.cache, name, row, table.dark[0])
            if (figures is None or "reaching" not in figures) and not asked.collect:
                figures = make_cell(replace(asked, name=name, data_seed=0), row, table.dark[0])
            if figures is not None and "reaching" in figures:
                found.append(figures | {"encoder": UNCONSTRAINED})
    return found


def _conserving(asked: Asked, name: str) -> Rows:
    kinds = {CONSERVING: EQUAL_LIGHT, **({MASK: INCOHERENT} if name in MASKED else {})}
    found = {(kind, light): equal_row(asked, name, way, light) for kind, way in kinds.items() for light in LIGHT}
    return [
        row | {"encoder": kind, "features": row["options"]["features"], "dark": 0.0}
        for (kind, _), row in found.items()
        if row is not None
    ]


def _light(way: str, reaching: float) -> float:
    """The light that direct imaging gets beside a row; networks get the next lower of `LIGHT`, as each level is a training."""
    most = min(reaching, PHOTONS_MAX[way])
    return max((light for light in LIGHT if light <= NEAR * most), default=LIGHT[0]) if way == NETWORK else most


def _direct(asked: Asked, name: str, way: str, photons: float) -> Row | None:
    made_with = {"task": name, "way": way, "photons": photons, "epochs": NETWORK_EPOCHS_ELSE}
    path = asked.cache / f"reaching-{name}-{way.replace(' ', '-')}-{photons:.6g}.json"

    def make() -> Row:
        task = load_task(name, asked.data_dir)
        frames = measure_frames(task, None)
        found = direct_figures(task, frames, photons, _decision(way, frames, photons)) | {"way": way}
        asked.report(f"{name}, direct imaging, {way}, {photons:,.0f} photons: {found['value']:.2f} %")
        return found

    return kept(path, made_with, make, collect=asked.collect)


def _decision(way: str, frames: Measurement, photons: float) -> Decide:
    if way == POSTERIOR:
        return bayes(frames, photons, "counting", seed=0, floor=FLOOR)[0]
    if way == NETWORK:
        return aware_cnn(frames, photons, "counting", seed=0, epochs=NETWORK_EPOCHS_ELSE)
    return (matched_decision if way == MATCHED else pairs_decision)(frames, photons, seed=0)


def reaching_tables(rows: Rows) -> list[Table]:
    """Return the table of encoders that conserve light, then that of unconstrained ones, each beside direct imaging at equal light."""
    compared = [row | against(row["value"], row["direct"]["value"], *_errors(row)) for row in rows]
    kinds = (CONSERVING, UNCONSTRAINED, MASK)
    there = [kind for kind in kinds if any(row["encoder"] == kind for row in compared)]
    return [_table(compared, kind, f"## W {kind}") for kind in there]


def _table(compared: Rows, kind: str, heading: str) -> Table:
    shown = [row for row in compared if row["encoder"] == kind]
    return Table(columns("reaching"), shown, heading, [claim("Ours", "direct imaging at this light", shown)])


def _errors(row: Row) -> tuple[float, float]:
    return row["error_objects"], row["direct"]["error_objects"]
