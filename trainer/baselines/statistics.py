"""Direct imaging decided by a statistic that suits the scene: a matched filter for an event, photon pairs for a speckle.

Owns the two statistics and how their thresholds are fitted on noisy training frames; the light, the detector and the score are those of
common.py. numpy only. Each `..._decision` is a function from a photon level to a decision `readouts -> labels`, of two classes. SIMULATED.

- `matched_decision`: the background is what a wide Gaussian holds of a frame, the event what a narrow one holds beyond it, in units of the
  background's shot noise; the largest value, bright or dark, is the statistic. Both widths and the threshold are chosen on training frames.
- `pairs_decision`: photon pairs at small distances over those of independent photons (the intensity correlation of Hanbury Brown and Twiss
  1956, over pixels instead of time), for which no pixel needs more than one photon. Linear discriminant of their logarithms.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .common import F32, F64, I64, Decide, Measurement, detect

EVENT_PX = (2.0, 2.75)  # standard deviations of the narrow Gaussian
BACKGROUND_PX = (5.0, 8.0, 12.0)  # and of the wide one
EDGE_PX = 8  # no event is looked for closer to the edge: the background is not known there
LAGS = (0, 1, 2, 3, 4, 6)  # pixels between the photons of a pair, along rows and columns
TRAINED_ON = 4000  # frames at most
RIDGE = 1e-6  # of the mean variance, for a discriminant whose features are nearly the same


def matched_decision(measurement: Measurement, photons: float, *, seed: int) -> Decide:
    """Return the decision of the matched filter at `photons` per frame; label 1 is the event."""
    shape = _frame_shape(measurement)
    readouts, labels = _noisy(measurement, photons, seed)
    statistics = [
        (lambda frames, event=event, wide=wide: matched(frames.reshape(-1, *shape), event, wide))
        for event in EVENT_PX
        for wide in BACKGROUND_PX
    ]
    fitted = [_threshold(statistic(readouts), labels) for statistic in statistics]
    best = max(range(len(fitted)), key=lambda i: fitted[i][0])
    return lambda frames: (statistics[best](frames) > fitted[best][1]).astype(np.int64)


def pairs_decision(measurement: Measurement, photons: float, *, seed: int) -> Decide:
    """Return the decision by photon pairs at `photons` per frame."""
    shape = _frame_shape(measurement)

    def features(frames: F32) -> F64:
        pairs = pair_excess(frames.reshape(-1, *shape))
        return np.log(pairs.clip(min=1 / (1 + photons)))  # a frame without a pair tells that there are few

    readouts, labels = _noisy(measurement, photons, seed)
    weights, threshold = _discriminant(features(readouts), labels)
    return lambda frames: (features(frames) @ weights > threshold).astype(np.int64)


def matched(frames: F32, event_px: float, background_px: float) -> F64:
    """Return the largest excess over the background inside the frames (n, rows, columns), bright or dark, in its shot noise; (n,)."""
    narrow, wide = (_blurs(frames.shape[1:], sigma) for sigma in (event_px, background_px))
    background = _blurred(frames, wide)
    excess = _blurred(frames, narrow) - background
    noise = np.sqrt(background.clip(min=background.mean(axis=(1, 2), keepdims=True) * 1e-3 + 1e-12))
    inner = slice(EDGE_PX, -EDGE_PX)
    largest: F64 = np.abs(excess / noise)[:, inner, inner].max(axis=(1, 2)).astype(np.float64)
    return largest


def pair_excess(frames: F32) -> F64:
    """Return photon pairs at each of `LAGS` over those of as many photons thrown anywhere, float64 (n, lags).

    1 is independence in an even light; at lag 0 it is 1 + contrast squared. A photon is no pair with itself. A frame of fewer than two
    photons gives 1.
    """
    total = frames.sum(axis=(1, 2), dtype=np.float64)
    everywhere = np.maximum(total * (total - 1), 1e-300)
    size = frames.shape[1] * frames.shape[2]
    found = np.empty((len(frames), len(LAGS)))
    for i, lag in enumerate(LAGS):
        if lag == 0:
            pairs, places = (frames * (frames - 1)).sum(axis=(1, 2), dtype=np.float64), size
        else:
            along = (frames[:, :, lag:] * frames[:, :, :-lag]).sum(axis=(1, 2), dtype=np.float64)
            across = (frames[:, lag:] * frames[:, :-lag]).sum(axis=(1, 2), dtype=np.float64)
            pairs = along + across
            places = size * 2 - lag * (frames.shape[1] + frames.shape[2])
        found[:, i] = pairs * size * size / places / everywhere
    found[total < 2] = 1.0
    return found


def _noisy(measurement: Measurement, photons: float, seed: int) -> tuple[F32, I64]:
    step = max(1, len(measurement.train) // TRAINED_ON)
    light = measurement.photoelectrons(measurement.train[::step], photons)
    return detect(light, "counting", np.random.default_rng([seed, 3])), measurement.train_labels[::step]


def _frame_shape(measurement: Measurement) -> tuple[int, int]:
    if measurement.image_shape is None or measurement.n_classes != 2:
        raise ValueError(
            f"{measurement.n_classes} classes, frames {measurement.image_shape}; allowed: frames of 2 classes"
        )
    return measurement.image_shape


def _blurs(shape: tuple[int, ...], sigma: float) -> tuple[F32, ...]:
    """Along rows and columns: matrices whose rows are Gaussians that sum to 1, so that the edge of a frame is not dark."""

    def blur(n: int) -> F32:
        places = np.arange(n)
        kernel = np.exp(-0.5 * ((places[:, None] - places) / sigma) ** 2)
        return np.asarray(kernel / kernel.sum(axis=1, keepdims=True), np.float32)

    return tuple(blur(n) for n in shape)


def _blurred(frames: F32, blurs: tuple[F32, ...]) -> F32:
    rows, columns = blurs
    return np.asarray(rows @ frames @ columns.T, np.float32)


def _threshold(values: F64, labels: I64) -> tuple[float, float]:
    """Return the best share of right decisions by `values > threshold`, and the threshold that reaches it."""
    order = np.argsort(values)
    ranked, events = values[order], labels[order]
    right = np.concatenate([[0], np.cumsum(1 - events)]) + (events.sum() - np.concatenate([[0], np.cumsum(events)]))
    cut = int(right.argmax())  # so many values lie below
    low, high = ranked[max(0, cut - 1)], ranked[min(len(ranked) - 1, cut)]
    return float(right[cut] / len(labels)), float(0.5 * (low + high))


def _discriminant(features: F64, labels: I64) -> tuple[F64, float]:
    """Fisher's linear discriminant of two classes, and the threshold that decides most training frames right."""
    of_class = [features[labels == label] for label in (0, 1)]
    within = sum(np.cov(rows, rowvar=False) for rows in of_class)
    within = np.asarray(within) + RIDGE * np.trace(within) / len(LAGS) * np.eye(len(LAGS))
    weights = np.linalg.solve(within, of_class[1].mean(axis=0) - of_class[0].mean(axis=0))
    return weights, _threshold(features @ weights, labels)[1]


DECISIONS: dict[str, Callable[..., Decide]] = {"matched filter": matched_decision, "photon pairs": pairs_decision}
