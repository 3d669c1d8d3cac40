"""The page `few-labels`: heads that `pans refit` can choose among, by the number of labelled objects; eigentasks beside the others.

Owns the cases, the draws and the table. Each labelled object is shown `SHOWN` times, so that the noise of the photons can be told from the
differences of objects (runtime/refit/eigentasks.py); every head is fitted to the same decisions, and judged on single decisions of the
other half of the test images, exactly. Three cases: the shipped patterns with their head, the image off by a pixel; the same with
nothing off, where the old head should stay; and random patterns that come without any head. SIMULATED.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import word_means
from pans.runtime.instrument.click_law import ClickLaw, click_probability
from pans.runtime.instrument.profile import load_profile
from pans.runtime.refit.choosing import CLEARLY, KINDS, Kind, Refitted, choose, fitted, kinds_for
from pans.runtime.refit.evidence import Evidence, evidence_of
from pans.trainer.baselines.common import measure
from pans.trainer.baselines.networks import patterns
from pans.trainer.evaluate.accuracy import light_of
from pans.trainer.paper.page import Asked, Made, Row, Rows, Table, columns, kept, pages
from pans.trainer.paper.swept import shipped_bundle
from pans.trainer.tasks.registry import load_task
from pans.trainer.verdicts import claim, verdict

TASK = "fashion-mnist"
SIZES = (50, 100, 200, 500, 1000)  # labelled objects
DRAWS = 20
SHOWN = 4  # times that each labelled object is shown
SHIFTED, UNKNOWN = "shipped patterns, image off by (1, 1) px", "ten random patterns without a head"
NOTHING = "shipped patterns, nothing off"
CASES = {SHIFTED: "shifted", NOTHING: "nothing", UNKNOWN: "random"}  # and the names of their parts
RANDOM_CLICKS = 5.0  # of ten: the light of the random patterns
OLD, EXISTING, ALL, PLAIN = (
    "old head",
    "refit without eigentasks",
    "refit, eigentasks among its kinds",
    "clicks as they are",
)
BESIDE, ALONE = "eigentasks, beside the old head", "eigentasks alone"
HEADS = (OLD, EXISTING, ALL, PLAIN, BESIDE, ALONE)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Chances of the click words of test images (n, 2**d_f), their labels, the old scores of all words, and the light of a decision."""

    name: str
    chance: F64
    labels: I64
    scores: F64
    light: dict[str, float]

    @property
    def means(self) -> F64:
        """The clicks of every word, (2**d_f, d_f)."""
        n = len(self.scores).bit_length() - 1
        return word_means(np.arange(len(self.scores)), n).astype(np.float64)


def few_labels_page(asked: Asked) -> Made:
    """Return one row per case, number of objects and head: means over the draws."""
    rows: Rows = []
    makers: dict[str, Callable[[str | None], Case]] = {
        SHIFTED: partial(_shipped, SHIFTED, 1),
        NOTHING: partial(_shipped, NOTHING, 0),
        UNKNOWN: _unknown,
    }
    for name, make in makers.items():
        case: Case | None = None
        for size in SIZES:
            made_with = {"case": name, "objects": size, "draws": DRAWS, "shown": SHOWN}
            path = asked.cache / f"few-labels-{CASES[name]}-{size}.json"
            if not asked.collect and case is None:
                case = make(asked.data_dir)
            found = kept(path, made_with, partial(_drawn, case, size), collect=asked.collect)
            if found is None:
                asked.report(f"few-labels, {name}, {size} objects: not measured yet (pans reproduce few-labels)")
                continue
            rows += [{**row, "case": name, "objects": size} for row in found["rows"]]
            asked.report(f"{name}, {size} objects: " + ", ".join(f"{r['value']:.2f}" for r in found["rows"]))
    return Made(rows)


def _shipped(name: str, off_px: int, data_dir: str | None) -> Case:
    bundle = shipped_bundle()
    test = load_task(TASK, data_dir).test
    moved = np.zeros_like(test.images)
    height, width = test.images.shape[1:]
    moved[:, off_px:, off_px:] = test.images[:, : height - off_px, : width - off_px]
    lit = light_of(bundle, load_profile(str(bundle.provenance["profile"])), moved)
    assert bundle.table is not None, "the shipped bundle has a table"
    light = {"photons": float(lit.photoelectrons.sum(axis=1).mean()), "illumination": lit.illumination}
    return _case(name, lit.probability, test.labels, bundle.table.astype(np.float64), light)


def _unknown(data_dir: str | None) -> Case:
    task = load_task(TASK, data_dir)
    measurement = measure(task, patterns("binary", 10, task.image_shape, seed=0))
    photons = _photons_for(lambda n: measurement.photoelectrons(measurement.test, n).astype(np.float64))
    lit = measurement.photoelectrons(measurement.test, photons).astype(np.float64)
    light = {"photons": photons, "illumination": measurement.illumination(photons)}
    p = click_probability(ClickLaw(), lit)
    return _case(UNKNOWN, p, task.test.labels, np.zeros((1 << 10, len(task.classes))), light)


def _photons_for(lit: Callable[[float], F64]) -> float:
    """The photons at which ten patterns click `RANDOM_CLICKS` times on average, by halving."""
    low, high = 0.1, 1000.0
    for _ in range(40):
        middle = math.sqrt(low * high)
        clicks = float(click_probability(ClickLaw(), lit(middle)).sum(axis=1).mean())
        low, high = (middle, high) if clicks < RANDOM_CLICKS else (low, middle)
    return low


def _case(name: str, p: F64, labels: I64, scores: F64, light: dict[str, float]) -> Case:
    chance = np.ones((len(p), 1))
    for column in p.T[:, :, None]:
        chance = np.concatenate([chance * (1 - column), chance * column], axis=1)
    centred = scores - scores.mean(axis=1, keepdims=True)
    return Case(name, chance, labels, centred, light | {"clicks": float(p.sum(axis=1).mean())})


def _drawn(case: Case | None, size: int) -> Row:
    assert case is not None, "made before it is drawn from"
    values: dict[str, list[float]] = {head: [] for head in HEADS}
    numbers: dict[str, list[int]] = {BESIDE: [], ALONE: []}
    names = []
    for seed in range(DRAWS):
        found = one_draw(case, size, seed)
        for head, (accuracy, name) in found.items():
            values[head].append(accuracy)
            if head in numbers:
                numbers[head].append(int(name.split()[0]))
        names.append(found[ALL][1])
    rows = []
    for head in HEADS:
        ahead = [a - b for a, b in zip(values[head], values[EXISTING])]
        row = {"head": head, "value": statistics.fmean(values[head]), "error": _error(values[head]), **case.light}
        row |= {"ahead": statistics.fmean(ahead), "ahead_error": _error(ahead)}
        row |= {"median_tasks": statistics.median(numbers[head])} if head in numbers else {}
        row |= {"taken": sum("eigentasks" in name for name in names)} if head == ALL else {}
        rows.append(row)
    return {"rows": rows}


def _error(values: list[float]) -> float:
    return statistics.stdev(values) / math.sqrt(len(values))


def one_draw(case: Case, size: int, seed: int) -> dict[str, tuple[float, str]]:
    """Return the accuracy in % of each head, and the name of its kind, fitted to `size` objects; judged on the other half, exactly."""
    rng = np.random.default_rng([seed, size])
    order = rng.permutation(len(case.labels))
    fit, judged = order[:size], order[len(order) // 2 :]
    object_id = np.repeat(np.arange(size), SHOWN)
    chance = case.chance[fit][object_id]
    row = (chance.cumsum(axis=1) < rng.random(len(object_id))[:, None] * chance.sum(axis=1, keepdims=True)).sum(axis=1)
    number, seen = np.unique(row, return_inverse=True)
    evidence = evidence_of(case.scores[number], case.means[number], seen, case.labels[fit][object_id], object_id)
    kinds = kinds_for(evidence, rows=False)
    trials = choose(evidence, kinds).trials
    existing = tuple(kind for kind in kinds if kind in KINDS)
    wanted: dict[str, Kind | None] = {
        OLD: None,
        EXISTING: _clearly_best(trials, existing),
        ALL: _clearly_best(trials, kinds),
        PLAIN: Kind(("bias", "clicks")),
        BESIDE: _best(trials, tuple(kind for kind in kinds if kind.tasks and not kind.alone)),
        ALONE: _best(trials, tuple(kind for kind in kinds if kind.tasks and kind.alone)),
    }
    weight = np.stack([case.chance[judged][case.labels[judged] == c].sum(axis=0) for c in range(case.scores.shape[1])])
    made: dict[Kind | None, float] = {}
    for kind in wanted.values():
        if kind not in made:
            made[kind] = _accuracy(case, evidence, kind, weight.T) / len(judged)
    return {head: (100 * made[kind], OLD if kind is None else kind.name) for head, kind in wanted.items()}


def _best(trials: dict[str, tuple[float, float]], kinds: tuple[Kind, ...]) -> Kind:
    return max(kinds, key=lambda kind: trials[kind.name][0])


def _clearly_best(trials: dict[str, tuple[float, float]], kinds: tuple[Kind, ...]) -> Kind | None:
    """As `choose` decides; None where the old head stays."""
    best = _best(trials, kinds)
    gain, error = trials[best.name]
    return best if gain > CLEARLY * error else None


def _accuracy(case: Case, evidence: Evidence, kind: Kind | None, weight: F64) -> float:
    """The chance of right decisions, summed over the objects that `weight` (words, classes) is of."""
    scores = case.scores
    if kind is not None:
        found: Refitted = fitted(evidence, kind, np.ones(evidence.n_objects, bool))
        assert found.correction is not None
        scores = found.correction.apply(case.scores, case.means)
    return float(weight[np.arange(len(scores)), scores.argmax(axis=1)].sum())


def few_labels_tables(rows: Rows) -> list[Table]:
    """Return one table per case: every head, held against the refit without eigentasks."""
    tables = []
    for case in CASES:
        mine = [row | _verdict(row) for row in rows if row["case"] == case]
        claims = [
            claim(head, EXISTING, [row for row in mine if row["head"] == head]) for head in (ALL, BESIDE, ALONE) if mine
        ]
        tables.append(Table(columns("few_labels"), mine, f"## {case[0].upper()}{case[1:]}", claims))
    return tables


def _verdict(row: Row) -> Row:
    """Draws are paired: the error is that of the differences."""
    return {} if row["head"] == EXISTING else {"verdict": verdict(row["ahead"], row["ahead_error"])}


PAGES = pages({"few-labels": (few_labels_page, few_labels_tables)})
