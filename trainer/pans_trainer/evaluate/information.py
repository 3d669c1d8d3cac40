"""How much the readouts know of the label: exact for click words, bounded for frames, and Fisher's ratio (paper, Fig. 2C). In bits.

- **Decisions** (`conveyed`): what the posteriors that stand behind them convey of the label, per decision and per unit of light.
- **Click words** (`word_information`): all 2**d_f click words of one shot are enumerated, so that I(label; clicks) of a set of
  objects is a sum, not an estimate. Posteriors are of the training objects, figures of others.
- **Frames** (`posterior_information`): nothing can be enumerated. A posterior q gives I >= H(label) - E[-log2 q(label)],
  whatever q is; the gap is how wrong q is. The mixture over the training objects knows the noise exactly and the world only as
  far as those objects go: at few photons the bound is tight, at many it is not (a network may know more).
- **Fisher ratio** (`fisher`): exact from the mean and variance of every readout; shot noise is part of the within-class spread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.instrument.click_law import ClickLaw, click_probability
from pans_trainer.figures import Result

from .readings import outcome_probabilities

SMOOTHING = 1e-9  # of a word's probability, given to every class: words that no training object shows say nothing
DISCRIMINANT_MAX = 2048
_CHUNK_NUMBERS = 1 << 22

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Conveyed(Result):
    """Bits of the class that the posterior of a decision conveys, and that per unit of light, with standard errors from the objects.

    None without a posterior, or without light.
    """

    bits: float | None = None
    bits_se: float | None = None
    bits_per_photon: float | None = None
    bits_per_photon_se: float | None = None
    bits_per_illumination: float | None = None
    bits_per_illumination_se: float | None = None


def conveyed(surprise: F64, labels: I64, photons: F64, illumination: F64 | float) -> dict[str, Any]:
    """Return the fields of `Conveyed` from the mean -log2 q(label) of each object, its photons and its illumination, all (n,).

    H(label) - E[-log2 q(label)], a lower bound of I(label; readings) whatever the posterior q. These objects chose nothing in q: their
    number brings no optimism. H(label), of their frequencies, is on average (classes - 1) / (2 n ln 2) too small.
    """
    n = len(labels)
    gain = -np.log2((np.bincount(labels) / n)[labels]) - surprise
    found: dict[str, Any] = {}
    lights = {"bits": np.ones(n), "bits_per_photon": photons, "bits_per_illumination": np.broadcast_to(illumination, n)}
    for name, light in lights.items():
        total = float(light.sum())
        if total:
            found[name] = ratio = float(gain.sum()) / total
            # the ratio's error by its derivative
            square = float(((gain - ratio * light) ** 2).sum())
            found[f"{name}_se"] = math.sqrt(square * n / max(n - 1, 1)) / total
    return found


def surprises(scores: NDArray[np.floating[Any]]) -> F64:
    """Return -log2 of the softmax of `scores`, float64 (n, classes)."""
    return -_log_softmax(scores.astype(np.float64)) / math.log(2)


@dataclass(frozen=True, slots=True)
class Information:
    """What click words know of new objects: a lower bound of the bits of the label, and the share of right decisions; mean clicks."""

    clicks: float
    bits: float
    accuracy: float


def word_joint(probability: F64, labels: I64, n_classes: int) -> F64:
    """Return P(click word, label), float64 (2**d_f, classes), over objects with click probabilities (n, d_f).

    Row index: pattern 0 is the lowest bit, as in a bundle's table.
    """
    words = 1 << probability.shape[1]
    joint, step = np.zeros((words, n_classes)), max(1, _CHUNK_NUMBERS // words)
    for start in range(0, len(probability), step):
        rows = slice(start, start + step)
        of_class = (labels[rows, None] == np.arange(n_classes)).astype(np.float64)
        joint += outcome_probabilities(probability[rows], 1).T @ of_class
    return joint / len(labels)


def mutual_information_bits(joint: F64) -> float:
    """Return I(row; column) of a joint distribution, in bits: at least 0, at most the smaller entropy."""
    rows, columns = joint.sum(axis=1, keepdims=True), joint.sum(axis=0, keepdims=True)
    there = joint > 0
    ratio = np.divide(joint, rows * columns, out=np.ones_like(joint), where=there)
    return max(0.0, float((joint[there] * np.log2(ratio[there])).sum()))


def entropy_bits(weights: F64) -> F64:
    """Return the entropy in bits of weights along the last axis, whatever they sum to; 0 where they are all 0."""
    total = weights.sum(axis=-1, keepdims=True)
    share = np.divide(weights, total, out=np.zeros_like(weights), where=total > 0)
    logs = np.log2(share, out=np.zeros_like(share), where=share > 0)
    return np.asarray(-(share * logs).sum(axis=-1))


def word_information(
    train: F64,
    train_labels: I64,
    test: F64,
    test_labels: I64,
    n_classes: int,
    *,
    law: ClickLaw = ClickLaw(),  # noqa: B008  frozen
) -> Information:
    """Return what the click words of an encoder know, exactly; `train` and `test` are photoelectrons per exposure (n, d_f).

    Decisions and bits are by the posteriors of the training objects; all is of the test objects.
    """
    p_train, p_test = click_probability(law, train), click_probability(law, test)
    joint = word_joint(p_train, train_labels, n_classes)
    smooth = joint + SMOOTHING * joint.sum(axis=0)
    log_posterior = np.log2(smooth / smooth.sum(axis=1, keepdims=True))
    decided = log_posterior.argmax(axis=1)
    heldout = word_joint(p_test, test_labels, n_classes)
    return Information(
        clicks=float(p_test.sum()) / len(test),
        bits=float(entropy_bits(heldout.sum(axis=0))) + float((heldout * log_posterior).sum()),
        accuracy=float(heldout[np.arange(len(decided)), decided].sum()),
    )


# ---- frames ----


@dataclass(frozen=True, slots=True)
class PosteriorInformation:
    """Of a sampled posterior. `lower_bits` bounds I(label; readout) from below, up to its standard error `lower_bits_se`.

    `believed_bits` is H(label) minus the mean entropy of the posterior: what the posterior thinks it knows. It is exact if
    the posterior is right (objects drawn from the mixture itself), and too high for new objects by over-confidence: the
    difference of the two shows the bias. `temperature` divided the log posterior to make the bound tight.
    """

    label_bits: float
    lower_bits: float
    lower_bits_se: float
    believed_bits: float
    temperature: float


def posterior_information(log_joint: F64, labels: I64) -> PosteriorInformation:
    """Return bounds from log P(readout, class) (n, classes), as `baselines.bayes.log_joint` gives, and the true labels (n,)."""
    log_posterior = _log_softmax(log_joint)
    n, n_classes = log_joint.shape
    surprise, temperature = cooled_surprise(log_posterior, labels)
    label_bits = float(entropy_bits(np.bincount(labels, minlength=n_classes) / n))
    return PosteriorInformation(
        label_bits=label_bits,
        lower_bits=label_bits - float(surprise.mean()),
        lower_bits_se=float(surprise.std(ddof=1)) / float(np.sqrt(n)),
        believed_bits=label_bits - float(entropy_bits(np.exp(log_posterior)).mean()),
        temperature=temperature,
    )


def cooled_surprise(scores: NDArray[np.floating[Any]], labels: I64) -> tuple[F64, float]:
    """Return -log2 q(label) of every readout, float64 (n,), q the softmax of `scores` (n, classes) over a temperature, and its mean.

    One half of the readouts chooses the temperature for the other half, so that what follows from it stays a bound.
    """
    log_posterior, rows = _log_softmax(scores.astype(np.float64)), np.arange(len(labels))
    half = rows % 2 == 0
    temperatures = [_best_temperature(log_posterior[part], labels[part]) for part in (~half, half)]
    return surprises(log_posterior / np.where(half, *temperatures)[:, None])[rows, labels], float(np.mean(temperatures))


def _log_softmax(rows: F64) -> F64:
    finite = np.maximum(rows, rows.max(axis=1, keepdims=True) - 1e6)  # a class that is ruled out stays a number
    return finite - np.logaddexp.reduce(finite, axis=1, keepdims=True)


def _best_temperature(log_posterior: F64, labels: I64) -> float:
    candidates = np.geomspace(0.5, 1e8, 140)  # a mixture is over-confident in proportion to the photons
    at = np.arange(len(labels))
    surprise = [-_log_softmax(log_posterior / t)[at, labels].mean() for t in candidates]
    return float(candidates[int(np.argmin(surprise))])


# ---- Fisher ----


@dataclass(frozen=True, slots=True)
class FisherRatio:
    """`trace` = tr(S_between) / tr(S_within); `discriminant` = tr(S_within^-1 S_between), over the best linear combinations.

    The discriminant is None beyond `DISCRIMINANT_MAX` readouts, whose scatter matrix would fill the memory.
    """

    trace: float
    discriminant: float | None


def fisher(mean: F64, variance: F64, labels: I64) -> FisherRatio:
    """Return Fisher's ratios of readouts that are independent given the object: `mean`, `variance` (objects, m) of each.

    Within-class scatter is that of the objects' means plus the noise; classes weigh by their objects. Counting: mean =
    variance = lambda. Clicks: p and p(1-p). Exact: nothing is sampled.
    """
    return _Scatter(mean, labels).ratio(variance.mean(axis=0))


def fisher_of_frames(light: F64, labels: I64, photons: Sequence[float]) -> list[FisherRatio]:
    """Return Fisher's ratios of counted readouts at every photon level; `light` (objects, m) is relative, one source for all.

    The scatter is computed once: light at eta has eta**2 times the scatter and eta times the noise.
    """
    per_object, scatter = float(light.sum()) / len(light), _Scatter(light, labels)
    return [scatter.ratio(light.mean(axis=0) * (per_object / level)) for level in photons]


class _Scatter:
    """Between-class and within-class scatter of the objects' means, without noise."""

    def __init__(self, mean: F64, labels: I64) -> None:
        classes, members = np.unique(labels, return_inverse=True)
        weight = np.bincount(members) / len(mean)
        of_class = np.stack([mean[members == c].mean(axis=0) for c in range(len(classes))])
        self.offsets = (of_class - mean.mean(axis=0)) * np.sqrt(weight)[:, None]
        apart = mean - of_class[members]
        self.within_trace = float((apart**2).sum()) / len(mean)
        self.within = apart.T @ apart / len(mean) if mean.shape[1] <= DISCRIMINANT_MAX else None

    def ratio(self, noise: F64) -> FisherRatio:
        """The ratios when every readout has the variance `noise` (m,) beside the scatter."""
        trace = float((self.offsets**2).sum()) / (self.within_trace + float(noise.sum()))
        if self.within is None:
            return FisherRatio(trace, None)
        seen = noise > 0  # readouts without noise are constant in every object: no light ever reaches them
        total, offsets = self.within[np.ix_(seen, seen)] + np.diag(noise[seen]), self.offsets[:, seen]
        return FisherRatio(trace, float((offsets * np.linalg.solve(total, offsets.T).T).sum()))
