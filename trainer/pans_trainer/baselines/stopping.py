"""Measurements that stop when they are sure: counts are read again and again while light is collected, until little doubt is left.

The counts are those of a frame's pixels, or of masks that are displayed in turn, again and again. Doubt has two sources: a network that
knows the exposure (networks.py, end_to_end.py), and the exact posterior over the training objects. The source and its rule, from which
doubt on it stops at which exposure, are chosen for each level of light on training objects that neither knew. SIMULATED: ideal detectors
without dark counts, which can be read at any time.

Exposures are in photons of the mean test object.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.machine import njit

from .bayes import FLOORS
from .common import F32, F64, I64, Light, Measurement, Report, Trials, blocks, silent

GRID = np.geomspace(1.0, 600.0, 65)  # exposures at which the counts are read
POSTERIOR_LONGEST = 100.0  # exposure; later the posterior is no rival of the network
SURE = 1e-5  # doubt at which every rule stops
HELD_BACK = 5000  # last training objects, which choose source and rule
GROWTHS = (-1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 8.0)
_MIDDLE = 40.0  # exposure at which a rule's `doubt` is stated


@dataclass(frozen=True, slots=True, eq=False)
class Arrivals:
    """All photons until the longest exposure: pixels by object and reading, and how many came until each, (objects, readings)."""

    pixels: NDArray[np.int32]
    photons: I64

    def between(self, rows: slice) -> Iterator[tuple[NDArray[np.int32], I64]]:
        """Yield for every reading the pixels hit since the one before it in objects `rows`, and for each the object's place in `rows`."""
        ends = self.photons[:, -1].cumsum()
        first = ends - self.photons[:, -1]
        until = self.photons[rows] + first[rows, None]
        since = np.concatenate([first[rows, None], until[:, :-1]], axis=1)
        for a, b in zip(since.T, until.T):
            who = np.repeat(np.arange(len(a)), b - a)
            yield self.pixels[np.arange(len(who)) + (a - np.concatenate([[0], (b - a).cumsum()[:-1]]))[who]], who


def arrivals(measurement: Measurement, rows: NDArray[np.generic], rng: np.random.Generator) -> Arrivals:
    """Draw the photons of every object of `rows`: a Poisson process in each pixel."""
    pixels, photons = [], []
    for block in blocks(len(rows), rows.shape[1]):
        counts = rng.poisson(measurement.photoelectrons(rows[block], GRID[-1]))
        who, pixel = np.nonzero(counts)
        who, pixel = (np.repeat(each, counts[counts > 0]) for each in (who, pixel))
        reading = np.searchsorted(GRID, rng.uniform(0, GRID[-1], len(who)))
        order = np.lexsort((reading, who))
        pixels.append(pixel[order].astype(np.int32))
        cell = np.bincount(who * len(GRID) + reading, minlength=len(counts) * len(GRID))
        photons.append(cell.reshape(-1, len(GRID)).cumsum(axis=1))
    return Arrivals(np.concatenate(pixels), np.concatenate(photons))


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """What a source says at every reading, (objects, readings): the likeliest label and `doubt`, 1 - its probability.

    Doubt is inf before the source says anything; what is as sure as `SURE` stays so. Every rule stops at the reading `last`.
    """

    labels: NDArray[np.int16]
    doubt: F32
    last: int

    def tell(self, place: I64 | int, k: int, chances: F64) -> None:
        """Note the chances (..., classes) of objects `place` at reading `k`, which stay unless a later reading changes them."""
        best = chances.argmax(axis=-1)
        others = chances.copy()
        np.put_along_axis(others, np.expand_dims(best, -1), 0.0, axis=-1)  # 1 - chance would lose small doubts
        self.labels[place, k:] = best[..., None]
        self.doubt[place, k:] = others.sum(axis=-1)[..., None]


Source = Callable[[Arrivals, Report], Course]


def _empty(n: int, latest: float) -> Course:
    """A course of `n` objects of which nothing is known yet, to the last reading until the exposure `latest`."""
    shape, last = (n, len(GRID)), int(np.searchsorted(GRID, latest, side="right")) - 1
    return Course(np.zeros(shape, np.int16), np.full(shape, np.inf, np.float32), last)


def of_network(
    log_chances: Callable[[F32, float], F64], n_pixels: int, earliest: float, latest: float = math.inf
) -> Source:
    """Return the source that asks log P(class | counts, exposure) from the exposure `earliest` to `latest`."""

    def follow(heard: Arrivals, report: Report) -> Course:
        course = _empty(len(heard.photons), latest)
        for rows in blocks(len(heard.photons), n_pixels):
            size = len(course.labels[rows])
            counts, unsure = np.zeros((size, n_pixels), np.float32), np.ones(size, bool)
            for k, (pixels, who) in enumerate(heard.between(rows)):
                np.add.at(counts, (who, pixels), 1)
                if earliest <= GRID[k] <= latest and unsure.any():
                    place = np.arange(size)[unsure] + rows.start
                    course.tell(place, k, np.exp(log_chances(counts[unsure], GRID[k])))
                    unsure[unsure] = course.doubt[place, k] > SURE
                report("network, reading by reading", (rows.start + size * (k + 1) / len(GRID)) / len(course.labels))
        return course

    return follow


def of_posterior(measurement: Measurement, floor: float, known: int) -> Source:
    """Return the source that knows the first `known` training objects, each as likely, every transmission lifted by `floor` (above 0).

    log P(photons | object) is the sum of the log rates at the pixels hit, less total rate x exposure.
    """
    order = np.argsort(measurement.train_labels[:known], kind="stable")
    labels, starts = np.unique(measurement.train_labels[order], return_index=True)
    rates = measurement.photoelectrons(measurement.train[order], 1.0, floor)
    totals = rates.sum(axis=1, dtype=np.float64).astype(np.float32)
    log_rates = np.ascontiguousarray(np.log(rates, out=rates).T)
    waits = np.diff(GRID[GRID <= POSTERIOR_LONGEST], prepend=0.0).astype(np.float32)

    def follow(heard: Arrivals, report: Report) -> Course:
        course, first = _empty(len(heard.photons), POSTERIOR_LONGEST), 0
        for i, photons in enumerate(heard.photons):
            log_joint, came = np.zeros(len(totals), np.float32), np.diff(photons, prepend=0)
            for k, wait in enumerate(waits):
                _hear(log_joint, log_rates, totals, heard.pixels[first : first + came[k]], wait)
                first += came[k]
                log_joint -= log_joint.max()
                masses = np.zeros(measurement.n_classes)
                masses[labels] = np.add.reduceat(np.exp(log_joint), starts)
                course.tell(i, k, masses / masses.sum())
                if course.doubt[i, k] <= SURE:
                    break
            first += photons[-1] - photons[k]
            report("posterior, reading by reading", (i + 1) / len(heard.photons))
        return course

    return follow


@njit(cache=True, nogil=True)
def _hear(log_joint: F32, log_rates: F32, totals: F32, pixels: NDArray[np.int32], wait: np.float32) -> None:
    """Add `pixels` hit during `wait` to `log_joint`, (objects,)."""
    for j in range(len(log_joint)):
        log_joint[j] -= wait * totals[j]
    for pixel in pixels:
        of_pixel = log_rates[pixel]
        for j in range(len(log_joint)):
            log_joint[j] += of_pixel[j]


@dataclass(frozen=True, slots=True)
class Rule:
    """Stop at the first reading whose doubt is at most `doubt` (exposure / 40)^`growth`, at least `SURE`."""

    doubt: float
    growth: float

    def stops(self, course: Course) -> I64:
        """Return the number of the reading at which each object is decided: the last where doubt remains."""
        with np.errstate(over="ignore"):
            limit = np.maximum(SURE, self.doubt * (GRID / _MIDDLE) ** self.growth)
        sure = course.doubt <= limit
        sure[:, course.last :] = True
        return sure.argmax(axis=1)


def at(values: NDArray[Any], stops: I64) -> NDArray[Any]:
    """Return what `values` (objects, readings) hold where each object stops."""
    return values[np.arange(len(stops)), stops]


def best_rule(course: Course, spent: F64, level: float, wanted: I64) -> tuple[float, Rule] | None:
    """Return the rule that decides best among those that spend `level` on average, and its accuracy; None where none spends as much.

    `spent` (objects, readings) grows along the readings.
    """
    found: list[tuple[float, Rule]] = []
    for growth in GROWTHS:
        low, high = -60.0, 60.0  # of log doubt; more doubt, earlier stops
        extremes = [at(spent, Rule(math.exp(edge), growth).stops(course)).mean() for edge in (high, low)]
        if not extremes[0] <= level <= extremes[1]:
            continue
        for _ in range(40):
            middle = (low + high) / 2
            if at(spent, Rule(math.exp(middle), growth).stops(course)).mean() <= level:
                high = middle
            else:
                low = middle
        rule = Rule(math.exp(high), growth)
        found.append((float((at(course.labels, rule.stops(course)) == wanted).mean()), rule))
    return max(found, key=lambda one: one[0], default=None)


def held_back(n: int) -> int:
    """Return how many of `n` training objects, the last ones, choose the rule."""
    return min(HELD_BACK, n // 5)


def stopping(
    measurement: Measurement,
    levels: Iterable[Light],
    network: Source,
    *,
    seed: int,
    trials: int = 1,
    report: Report = silent,
) -> Iterator[tuple[Light, dict[str, Any], Trials]]:
    """Yield for every level that can be reached source, rule and mean confidence, and what was decided on the test objects, `trials` times.

    `network` does not know the objects held back. Clicks, photons and illumination are those until the decision (every photon is a click
    of its own).
    """
    n = len(measurement.train)
    known = n - held_back(n)
    rows, wanted, rng = measurement.train[known:], measurement.train_labels[known:], np.random.default_rng([seed, 2])
    held = arrivals(measurement, rows, rng)
    share = measurement.photoelectrons(rows, 1.0).sum(axis=1, dtype=np.float64).mean()  # beside the test objects' mean
    spent = {"photons": held.photons / share, "illumination": measurement.sent(rows, 1.0)[:, None] * GRID}
    courses: dict[float | None, Course] = {None: network(held, report)}  # by the floor of the posterior
    courses |= {floor: of_posterior(measurement, floor, known)(held, report) for floor in FLOORS}
    rng = np.random.default_rng([seed, 1])
    heard = [arrivals(measurement, measurement.test, rng) for _ in range(trials)]
    sent = measurement.sent(measurement.test, 1.0)[:, None] * GRID
    told: dict[float | None, list[Course]] = {}
    for level in levels:
        rules = [
            (found, floor)
            for floor, course in courses.items()
            if (found := best_rule(course, spent[level.of], level.amount, wanted))
        ]
        if not rules:
            continue
        (right, rule), floor = max(rules, key=lambda one: one[0][0])
        if floor not in told:
            source = network if floor is None else of_posterior(measurement, floor, n)
            told[floor] = [source(each, report) for each in heard]
        done, confidence = decided(measurement, told[floor], [each.photons for each in heard], sent, rule)
        facts = {"source": "network" if floor is None else "posterior", "floor": floor, "accuracy_held_back": right}
        yield level, facts | {"confidence": confidence} | asdict(rule), done


def decided(
    measurement: Measurement, told: Sequence[Course], photons: Sequence[NDArray[Any]], sent: F64, rule: Rule
) -> tuple[Trials, float]:
    """Return what `rule` decides on the test objects, and its mean confidence, from one course and photons of each trial.

    `photons` and `sent`, (objects, readings), are those until a reading.
    """
    stops = [rule.stops(course) for course in told]
    right = [at(course.labels, k) == measurement.test_labels for course, k in zip(told, stops)]
    detected: F64 = np.mean([at(each, k) for each, k in zip(photons, stops)], axis=0)
    illumination, doubt = np.mean([at(sent, k) for k in stops]), [at(course.doubt, k) for course, k in zip(told, stops)]
    return Trials(np.array(right), detected, detected, float(illumination)), 1 - float(np.mean(doubt))
