"""Eigentasks: the combinations of clicks that the sampling of photons disturbs least, in the order of their noise.

    N r = share T r        share = noise / (signal + noise)

T is the covariance of the click means over decisions, N that part of it which the photons' randomness alone makes: the solution with the
smallest share first. A head of the first few learns from few labelled objects, since the noisiest directions are left out (F. Hu et al.,
"Tackling sampling noise in physical systems for machine learning applications", Phys. Rev. X 13, 041020, 2023; "few labels": arXiv
2605.10008). No label enters. Clicks of different exposures are independent, so that N is diagonal.

N is measured: by objects that were shown several times, or by decisions of several shots. Of objects that were shown once by one shot
nothing tells noise from signal, and there are no eigentasks. An automaton has none either: which pattern comes next depends on the
clicks before, and clicks of different walks are not of the same patterns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .evidence import F64, Evidence

RIDGE = 1e-6  # of the mean variance: channels that never or always click have none of their own
REPEATED_MIN = 20  # objects shown again, below which their scatter is no measure


class Eigentasks(NamedTuple):
    """`readout` (d_f, d_f): column k times the clicks is eigentask k, of unit variance over decisions; `noise_share` (d_f,), rising."""

    readout: F64
    noise_share: F64


def eigentasks(evidence: Evidence, chosen: NDArray[np.bool_] | None = None) -> Eigentasks | None:
    """Return the eigentasks of the clicks of the objects `chosen` (objects,), all unless given; None where noise cannot be told."""
    taken = np.ones(len(evidence.row), bool) if chosen is None else chosen[evidence.object_id]
    clicks, object_id = evidence.clicks[evidence.row[taken]], evidence.object_id[taken]
    if not clicks.shape[1] or len(clicks) < 2:
        return None
    noise = _noise(clicks, object_id, evidence.shots)
    if noise is None:
        return None
    centred = clicks - clicks.mean(axis=0)
    total = centred.T @ centred / (len(clicks) - 1)
    total[np.diag_indices(len(total))] += RIDGE * max(float(np.trace(total)) / len(total), RIDGE)
    # with T = L L^T the problem is an ordinary one: (L^-1 N L^-T) q = share q, r = L^-T q
    inverse = np.linalg.inv(np.linalg.cholesky(total))
    share, directions = np.linalg.eigh(inverse * noise @ inverse.T)
    return Eigentasks(inverse.T @ directions, share)


def _noise(clicks: F64, object_id: NDArray[np.int64], shots: int) -> F64 | None:
    """The variance of each click mean about its object's expectation, (d_f,): by repeated objects, else by the shots of a decision."""
    times = np.bincount(object_id)
    again = times > 1
    if int(again.sum()) >= REPEATED_MIN:
        sums = np.zeros((len(times), clicks.shape[1]))
        np.add.at(sums, object_id, clicks)
        means = sums / np.maximum(times, 1)[:, None]
        inside = again[object_id]
        scatter = ((clicks - means[object_id])[inside] ** 2).sum(axis=0)
        return np.asarray(scatter / (times[again] - 1).sum())
    if shots > 1:
        return np.asarray((clicks * (1 - clicks)).mean(axis=0) / (shots - 1))
    return None
