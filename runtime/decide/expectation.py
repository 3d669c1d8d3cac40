"""What an automaton does on given objects, exactly: no trials, no sampling error.

Owns the sums over all walks. P(node | object) is carried forward slot by slot, alpha(s') = sum of alpha(s) P(outcome | s, object) over the
edges into s', in float64, whether the outcomes are clicks, photon numbers or the clicks of several channels, which are independent given
the object: every state is at one depth, so that alpha is whole when its slot comes. Where the detector has afterpulses, a click depends on
the click before: alpha is then carried for both outcomes of the last exposure; where they have a time constant, with the memory of each
(remembering.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.detector import Afterpulses
from pans.runtime.instrument.click_law import ClickLaw, CountLaw, both_chances, count_chances, log_no_click, outcomes_of

from .remembering import Remembered

NO_AFTERPULSES = Afterpulses(0.0)
LEAF_NUMBERS_MAX = 1 << 27  # objects times leaves that are returned at once: 1 GiB
_NUMBERS_AT_ONCE = 1 << 22
_PATTERNS_AT_ONCE = 2048

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedWalk:
    """Expected sums per decision of each object, float64 (n,), and the chance of each leaf, float64 (n, leaves).

    `clicks` are the photons counted, where a reading says how many.
    `photons` are photoelectrons of the light, dark counts not among them; `illumination` the intensities of the patterns that are shown.
    """

    clicks: F64
    photons: F64
    illumination: F64
    exposures: F64
    leaves: F64
    ends: F64 | None = (
        None  # (n, 2): mean and mean square of the carriers in traps behind a walk, where afterpulses have a time constant
    )


def expected_walk(
    automaton: Automaton,
    patterns: NDArray[Any],
    transmission: NDArray[np.floating[Any]],
    law: ClickLaw | CountLaw,
    photons_per_level: float = 1.0,
    *,
    afterpulses: Afterpulses = NO_AFTERPULSES,
    begins: tuple[float, float] = (0.0, 0.0),
) -> ExpectedWalk:
    """Return what `automaton` does on each of n objects, exactly.

    `patterns` (n_patterns, pixels) times `photons_per_level` are photoelectrons per exposure and unit transmission, lit all the
    time; `transmission` (n, pixels), 0 to 1. `law` is that of one whole exposure: dark counts and read noise come whatever the dwell.
    Of `afterpulses` without a time constant a click makes the next exposure click as well; the exposure before a walk is taken to have
    none (that of the last object's end is forgotten, at most one click in so many walks). With one, `begins` is the memory with which a
    walk begins, mean and variance, and remembering.py says what is exact.
    Of several channels `law` is that of each. ValueError for shapes that do not fit, a law of other outcomes than the automaton's, and
    afterpulses of a detector that counts or of several channels.
    """
    _check_arguments(automaton, patterns, transmission)
    _check_law(automaton, law, afterpulses)
    n, n_leaves = len(transmission), automaton.n_leaves
    ends = np.empty((n, 2)) if afterpulses.time else None
    found = ExpectedWalk(np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty((n, n_leaves)), ends)
    step = max(1, _NUMBERS_AT_ONCE // max(len(patterns), len(automaton.posteriors)))
    slots, shown = _states_by_slot(automaton), patterns.sum(axis=1, dtype=np.float64) * photons_per_level
    for start in range(0, n, step):
        here = slice(start, min(start + step, n))
        light = pattern_light(patterns, transmission[here], photons_per_level)
        walked: _Walked
        if automaton.channels > 1 and isinstance(law, ClickLaw):
            walked = _ByWords(automaton, law, len(light))
        elif isinstance(law, CountLaw):
            walked = _ByNumbers(automaton, law, len(light))
        elif afterpulses.time:
            walked = _ByMemory(Remembered(automaton, afterpulses, len(light), begins), law, automaton.n_states)
        else:
            walked = _ByClicks(automaton, law, len(light), afterpulses.probability)
        _walk_block(automaton, slots, light, shown, walked, found, here)
    return found


def _check_arguments(automaton: Automaton, patterns: NDArray[Any], transmission: NDArray[Any]) -> None:
    if patterns.ndim != 2 or transmission.ndim != 2 or patterns.shape[1] != transmission.shape[1]:
        raise ValueError(f"patterns {patterns.shape} and objects {transmission.shape}, allowed: the same pixels")
    last = int(automaton.pattern.max()) + automaton.channels - 1
    if last >= len(patterns):
        raise ValueError(f"a state shows pattern {last} of {len(patterns)}")
    if len(transmission) * automaton.n_leaves > LEAF_NUMBERS_MAX:
        most = LEAF_NUMBERS_MAX // automaton.n_leaves
        raise ValueError(
            f"{len(transmission)} objects and {automaton.n_leaves} leaves, allowed: {most} objects at once"
        )


def _check_law(automaton: Automaton, law: ClickLaw | CountLaw, afterpulses: Afterpulses) -> None:
    outcomes = outcomes_of(law)
    wanted = automaton.n_outcomes if automaton.counts else 2
    if outcomes != wanted or (automaton.n_outcomes > 2 and afterpulses):
        found = f"{outcomes}, afterpulse {afterpulses.probability:g}"
        raise ValueError(
            f"an automaton of {automaton.n_outcomes} outcomes under a law of {found}, allowed: the same outcomes, and no afterpulses "
            "where photons are counted or several channels are read at once"
        )


def _states_by_slot(automaton: Automaton) -> list[NDArray[np.int64]]:
    order = np.argsort(automaton.depth, kind="stable").astype(np.int64)
    ends = np.searchsorted(automaton.depth[order], np.arange(automaton.n_slots + 1))
    return [order[ends[slot] : ends[slot + 1]] for slot in range(automaton.n_slots)]


def pattern_light(patterns: NDArray[Any], transmission: NDArray[Any], scale: float) -> F64:
    """Return photoelectrons, float64 (objects, patterns), with the light on all the time; arguments as in `expected_walk`."""
    wide = transmission.astype(np.float64)
    light = np.empty((len(wide), len(patterns)))
    for start in range(0, len(patterns), _PATTERNS_AT_ONCE):
        part = patterns[start : start + _PATTERNS_AT_ONCE]
        light[:, start : start + _PATTERNS_AT_ONCE] = wide @ part.T.astype(np.float64)
    light *= scale
    return light


class _Walked(Protocol):
    """The walks of some objects, carried on slot by slot."""

    def go_on(self, states: NDArray[np.int64], photoelectrons: F64) -> tuple[F64, F64]:
        """Leave `states` (m,) of one slot, shown with `photoelectrons` (objects, m), of several channels (objects, m, channels).

        Returns the chances with which the objects reached them (objects, m), and the expected clicks (objects,).
        """

    def leaves(self) -> F64:
        """The chance of each leaf, (objects, leaves)."""

    def ends(self) -> F64 | None:
        """Moments of the detector's memory behind a walk, (objects, 2), where it has one."""


class _ByClicks:
    """Walks by clicks, each of which may make the next exposure click too."""

    def __init__(self, automaton: Automaton, law: ClickLaw, n: int, afterpulse: float) -> None:
        self._automaton, self._law, self._afterpulse = automaton, law, afterpulse
        self._alpha = np.zeros((2 if afterpulse else 1, n, len(automaton.posteriors)))
        self._alpha[0, :, 0] = 1.0

    def go_on(self, states: NDArray[np.int64], photoelectrons: F64) -> tuple[F64, F64]:
        alpha, afterpulse = self._alpha, self._afterpulse
        reached = alpha[:, :, states].sum(axis=0)
        click, miss = both_chances(self._law, photoelectrons)  # 1 - p would lose the digits of what is all but certain
        clicked = alpha[-1][:, states] * (miss * afterpulse) if afterpulse else 0.0  # by afterpulses alone
        pass_on(alpha, states, self._automaton.successors, (click, miss), afterpulse)
        return reached, (reached * click + clicked).sum(axis=1)

    def leaves(self) -> F64:
        return np.asarray(self._alpha[:, :, self._automaton.n_states :].sum(axis=0))

    def ends(self) -> None:
        return None


class _ByNumbers:
    """Walks by photon numbers."""

    def __init__(self, automaton: Automaton, law: CountLaw, n: int) -> None:
        self._automaton, self._law = automaton, law
        self._alpha = np.zeros((n, len(automaton.posteriors)))
        self._alpha[:, 0] = 1.0

    def go_on(self, states: NDArray[np.int64], photoelectrons: F64) -> tuple[F64, F64]:
        reached = self._alpha[:, states]
        chances = count_chances(self._law, photoelectrons)
        pass_counts_on(self._alpha, states, self._automaton.successors, chances)
        return reached, (reached * np.tensordot(np.arange(len(chances)), chances, 1)).sum(axis=1)

    def leaves(self) -> F64:
        return self._alpha[:, self._automaton.n_states :]

    def ends(self) -> None:
        return None


class _ByWords:
    """Walks by the clicks of several channels at once."""

    def __init__(self, automaton: Automaton, law: ClickLaw, n: int) -> None:
        self._automaton, self._law = automaton, law
        self._alpha = np.zeros((n, len(automaton.posteriors)))
        self._alpha[:, 0] = 1.0

    def go_on(self, states: NDArray[np.int64], photoelectrons: F64) -> tuple[F64, F64]:
        reached = self._alpha[:, states]
        click, miss = both_chances(self._law, photoelectrons)
        chances = word_chances(click, miss)
        pass_counts_on(self._alpha, states, self._automaton.successors, chances)
        return reached, (reached * click.sum(axis=2)).sum(axis=1)

    def leaves(self) -> F64:
        return self._alpha[:, self._automaton.n_states :]

    def ends(self) -> None:
        return None


def word_chances(click: F64, miss: F64) -> F64:
    """Return the chance of each outcome, (2**channels, n, m), from those of a click and of none in each channel, (n, m, channels)."""
    chances = np.ones((1, *click.shape[:2]))
    for channel in range(click.shape[2]):
        chances = np.concatenate([chances * miss[:, :, channel], chances * click[:, :, channel]])
    return chances


class _ByMemory:
    """Walks by clicks on a detector that remembers several exposures."""

    def __init__(self, walked: Remembered, law: ClickLaw, n_states: int) -> None:
        self._walked, self._law, self._n_states = walked, law, n_states

    def go_on(self, states: NDArray[np.int64], photoelectrons: F64) -> tuple[F64, F64]:
        return self._walked.go_on(states, -log_no_click(self._law, photoelectrons))

    def leaves(self) -> F64:
        return np.asarray(self._walked.chance[:, :, self._n_states :].sum(axis=0))

    def ends(self) -> F64:
        return self._walked.ends.T


def _walk_block(
    automaton: Automaton,
    slots: list[NDArray[np.int64]],
    light: F64,
    shown: F64,
    walked: _Walked,
    found: ExpectedWalk,
    here: slice,
) -> None:
    """Carry `walked` through all slots; `light` (objects, patterns) and `shown` (patterns,) of the patterns, lit all the time."""
    sums = np.zeros((4, len(light)))
    for states in slots:
        rows = automaton.rows[states]
        share = automaton.dwell[states] / automaton.dwell_steps
        each = light[:, rows] * share[:, None]
        photoelectrons = each[:, :, 0] if automaton.channels == 1 else each
        reached, clicks = walked.go_on(states, photoelectrons)
        sums[0] += clicks
        sums[1] += (reached * each.sum(axis=2)).sum(axis=1)
        sums[2] += reached @ (shown[rows].sum(axis=1) * share)
        sums[3] += reached.sum(axis=1)
    for total, row in zip((found.clicks, found.photons, found.illumination, found.exposures), sums):
        total[here] = row
    found.leaves[here] = walked.leaves()
    ends = walked.ends()
    if found.ends is not None and ends is not None:
        found.ends[here] = ends


@njit(cache=True, nogil=True)
def pass_counts_on(alpha: F64, states: NDArray[np.int64], successors: NDArray[np.uint32], chances: F64) -> None:
    """Add what leaves each of `states` (m,) to its successors: alpha (n, nodes), chances (outcomes, n, m)."""
    for i in range(alpha.shape[0]):
        for k in range(states.size):
            reached = alpha[i, states[k]]
            for outcome in range(chances.shape[0]):
                alpha[i, successors[states[k], outcome]] += reached * chances[outcome, i, k]


@njit(cache=True, nogil=True)
def pass_on(
    alpha: F64, states: NDArray[np.int64], successors: NDArray[np.uint32], chances: tuple[F64, F64], afterpulse: float
) -> None:
    """Add what leaves each of `states` (m,) to its successors: alpha (k, n, nodes), chances (n, m) of a click and of none.

    alpha[1] is what came by a click, which `afterpulse` adds to the next; with k = 1 what was before makes no difference.
    """
    click, miss = chances
    last = alpha.shape[0] - 1
    for before in range(alpha.shape[0]):
        stays = 1.0 - afterpulse * before
        for i in range(alpha.shape[1]):
            for k in range(states.size):
                state = states[k]
                reached = alpha[before, i, state]
                alpha[0, i, successors[state, 0]] += reached * miss[i, k] * stays
                alpha[last, i, successors[state, 1]] += reached * (click[i, k] + miss[i, k] * (1.0 - stays))
