"""Direct imaging that stops when it is sure: photons come one by one, after each the exact posterior is known.

The posterior is that of bayes.py, here of a Poisson process: log P = sum of log rate at the pixels that were hit - total rate x elapsed
time. It knows pixels and times; a decision falls after a photon only. SIMULATED: an ideal camera that reports every photon at once, no dark
counts. Time is measured in exposures that give one photon per object (`Measurement.photoelectrons` at 1 photon).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from .bayes import FLOORS, VALIDATION_OBJECTS
from .common import F32, F64, I64, Measurement, Report, Trials, silent

MOST = 200  # photons after which a decision falls, sure or not
SURE = 1e-3  # doubt below which the posterior is no longer followed: no threshold is asked to be stricter
HELD_OUT = 10_000  # last training objects, among which floor and thresholds are chosen
_ROWS = 8  # objects followed at a time: 2 MiB of log-likelihoods of 60 000 training objects


@dataclass(frozen=True, slots=True, eq=False)
class Arrivals:
    """Photons of one object per row: pixel and time of each, (objects, most); without light the times are inf."""

    pixels: NDArray[np.int32]
    times: F32


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """What is known after each photon, (objects, most): the likeliest label, and `doubt`, 1 - its posterior; what is sure stays."""

    labels: NDArray[np.int16]
    doubt: F32

    def stops(self, doubt: float) -> I64:
        """Return how many photons each object takes until its doubt is at most `doubt`: all of them where it never is."""
        sure = self.doubt <= np.float32(doubt)
        most = self.doubt.shape[1]
        return np.where(sure.any(axis=1), sure.argmax(axis=1) + 1, most)


def arrivals(
    measurement: Measurement, rows: NDArray[np.generic], rng: np.random.Generator, most: int = MOST
) -> Arrivals:
    """Draw the first `most` photons of every object: exponential waiting times, pixels by their share of the light."""
    rates = measurement.photoelectrons(rows, 1.0)
    pixels, times = np.zeros((len(rates), most), np.int32), np.full((len(rates), most), np.inf, np.float32)
    waits, chances = rng.exponential(size=times.shape), rng.random(times.shape)
    for i, of_object in enumerate(rates):
        below = np.cumsum(of_object, dtype=np.float64)
        if below[-1] > 0:
            pixels[i] = np.searchsorted(below / below[-1], chances[i], side="right")
            times[i] = np.cumsum(waits[i]) / below[-1]
    return Arrivals(pixels, times)


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """The training objects by class: log rates (pixels, objects), total rates (objects,), first object of each class."""

    log_rates: F32
    totals: F32
    starts: I64
    labels: I64  # of the classes that have objects, by `starts`


def mixture(measurement: Measurement, floor: float, left_out: I64 | None = None) -> Mixture:
    """Return the training objects of `measurement` but those numbered `left_out`, every transmission lifted by `floor` (above 0)."""
    kept = np.ones(len(measurement.train_labels), bool)
    if left_out is not None:
        kept[left_out] = False
    order = np.argsort(measurement.train_labels, kind="stable")
    order = order[kept[order]]
    rates = measurement.photoelectrons(measurement.train[order], 1.0, floor)
    totals = rates.sum(axis=1, dtype=np.float64).astype(np.float32)
    labels, starts = np.unique(measurement.train_labels[order], return_index=True)
    return Mixture(np.ascontiguousarray(np.log(rates, out=rates).T), totals, starts.astype(np.int64), labels)


@numba.njit(cache=True, nogil=True)
def _hear(log_joint: F32, log_rates: F32, totals: F32, pixels: NDArray[np.int32], waits: F32) -> None:
    """Add one photon to each row of `log_joint`, (rows, objects)."""
    for i in range(len(log_joint)):
        row, of_pixel, wait = log_joint[i], log_rates[pixels[i]], waits[i]
        for j in range(len(row)):
            row[j] += of_pixel[j] - wait * totals[j]


def follow(known: Mixture, heard: Arrivals, report: Report = silent) -> Course:
    """Return the posterior of every object after each of its photons, in log space, until its doubt is below `SURE`."""
    n, most = heard.pixels.shape
    labels, doubt = np.zeros((n, most), np.int16), np.ones((n, most), np.float32)
    alive = np.flatnonzero(np.isfinite(heard.times[:, 0])) if most else np.empty(0, np.int64)
    waits = np.diff(heard.times[alive], axis=1, prepend=np.float32(0)).astype(np.float32)
    labels[:] = known.labels[
        np.argmax(np.diff(known.starts, append=len(known.totals)))
    ]  # the most frequent: without light
    place, taken = np.arange(min(_ROWS, len(alive))), min(_ROWS, len(alive))  # into `alive`
    step = np.zeros(len(place), np.int64)
    log_joint = np.zeros((len(place), len(known.totals)), np.float32)
    scratch = np.empty_like(log_joint)
    while len(place):
        who = alive[place]
        _hear(log_joint, known.log_rates, known.totals, heard.pixels[who, step], waits[place, step])
        log_joint -= log_joint.max(axis=1, keepdims=True)
        weights = np.exp(log_joint, out=scratch[: len(place)])
        masses = np.add.reduceat(weights, known.starts, axis=1).astype(np.float64)
        best = masses.argmax(axis=1)
        lost = (masses.sum(axis=1) - masses[np.arange(len(best)), best]) / masses.sum(axis=1)
        labels[who, step], doubt[who, step] = known.labels[best], np.maximum(lost, 0)
        step += 1
        ended = np.flatnonzero((step == most) | (lost < SURE))
        for i in ended:  # what is sure stays so
            for known_now in (labels, doubt):
                known_now[who[i], step[i] :] = known_now[who[i], step[i] - 1]
        place, step, log_joint, taken = _replaced(ended, place, step, log_joint, taken, len(alive))
        report("photon by photon", taken / max(1, len(alive)))
    return Course(labels, doubt)


def _replaced(ended: I64, place: I64, step: I64, log_joint: F32, taken: int, n: int) -> tuple[I64, I64, F32, int]:
    """Give the rows that have ended to objects not yet begun, and drop them where there are none."""
    fresh = min(len(ended), n - taken)
    into, dropped = ended[:fresh], ended[fresh:]
    place[into], step[into], log_joint[into] = np.arange(taken, taken + fresh), 0, 0.0
    if len(dropped):
        place, step = np.delete(place, dropped), np.delete(step, dropped)
        log_joint = np.delete(log_joint, dropped, axis=0)
    return place, step, log_joint, taken + fresh


def threshold_for(course: Course, photons: float) -> float:
    """Return the doubt at which the mean number of photons is as near to `photons` as can be from below; ValueError out of reach."""
    low, high = course.stops(SURE).mean(), course.stops(1.0).mean()
    if not high <= photons <= low:
        raise ValueError(
            f"photons is {photons:g}, allowed when stopping: {high:g} to {low:.1f}, the mean when sure to 1 - {SURE:g}"
        )
    sure, unsure = math.log(SURE), 0.0
    for _ in range(60):
        middle = (sure + unsure) / 2
        if course.stops(math.exp(middle)).mean() <= photons:
            unsure = middle
        else:
            sure = middle
    return math.exp(unsure)


@dataclass(frozen=True, slots=True)
class Rule:
    """When to stop at a mean number of photons: the doubt, and the floor of the mixture."""

    photons: float
    doubt: float
    floor: float


def rules(measurement: Measurement, levels: Iterable[float], seed: int, report: Report = silent) -> list[Rule]:
    """Choose one floor and a threshold per level, on some of the last training objects left out of the mixture.

    Levels beyond what doubt `SURE` takes are left out.
    """
    n, rng = len(measurement.train_labels), np.random.default_rng([seed, 2])
    last = np.arange(max(0, n - HELD_OUT), n)
    chosen = np.sort(rng.permutation(last)[: min(VALIDATION_OBJECTS, n // 5)])
    heard, wanted = arrivals(measurement, measurement.train[chosen], rng), measurement.train_labels[chosen]
    best: tuple[float, list[Rule]] = (-1.0, [])
    for floor in FLOORS:
        course = follow(mixture(measurement, floor, chosen), heard, report)
        found, right = [], 0.0
        for photons in levels:
            try:
                found.append(Rule(photons, threshold_for(course, photons), floor))
            except ValueError:
                continue
            right += float((_decided(course, found[-1].doubt)[0] == wanted).mean())
        best = max(best, (right, found), key=lambda one: one[0])
    return best[1]


def _decided(course: Course, doubt: float) -> tuple[NDArray[np.int16], I64]:
    stops = course.stops(doubt)
    return course.labels[np.arange(len(stops)), stops - 1], stops


def stopping(
    measurement: Measurement, levels: Iterable[float], *, seed: int, trials: int = 1, report: Report = silent
) -> Iterator[tuple[Rule, Trials]]:
    """Yield for every level that can be reached what was decided on the test objects, each `trials` times.

    Photons and clicks are those detected until the decision (every photon is a click of its own); the illumination is that until then.
    """
    chosen = rules(measurement, levels, seed, report)
    if not chosen:
        return
    known, rng = mixture(measurement, chosen[0].floor), np.random.default_rng([seed, 1])
    courses: list[tuple[Course, Arrivals]] = []
    for _ in range(trials):
        heard = arrivals(measurement, measurement.test, rng)
        courses.append((follow(known, heard, report), heard))
    lit, of_time = np.isfinite(courses[0][1].times[:, 0]), measurement.illumination(1.0)
    for rule in chosen:
        right = np.empty((trials, len(lit)), bool)
        photons: F64 = np.zeros(len(lit))
        elapsed = 0.0
        for trial, (course, heard) in enumerate(courses):
            labels, stops = _decided(course, rule.doubt)
            right[trial] = labels == measurement.test_labels
            photons += np.where(lit, stops, 0) / trials
            elapsed += float(heard.times[lit, stops[lit] - 1].sum(dtype=np.float64)) / len(lit) / trials
        yield rule, Trials(right, photons, photons, elapsed * of_time)
