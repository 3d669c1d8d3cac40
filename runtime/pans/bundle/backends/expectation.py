"""An automaton, its light on given objects and a detector's law in; what its walks do, exactly, out: no trials, no sampling error.

P(node | object) is carried forward slot by slot, alpha(s') = sum of alpha(s) P(outcome | s, object) over the edges into s', in float64:
every state is at one depth, so that alpha is whole when its slot comes. The clicks of several channels are independent given the object.
Where the detector has afterpulses, a click depends on the click before: alpha is carried for both outcomes of the last exposure. Where they
have a time constant, beside it stands the memory (instrument/detector/afterpulses.py) of the walks that came so, as the sums of its mean
and of its mean square; where several walks meet, their moments are those of all of them together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.machine import njit
from pans.bundle.automaton import Automaton
from pans.instrument.click_law import ClickLaw, CountLaw, both_chances, count_chances, log_no_click, outcomes_of
from pans.instrument.detector import LEAST_MEAN, SMALL_RATIO, Afterpulses

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
    first_clicked: F64  # chance that state 0 clicks, in any of its channels
    leaves: F64
    ends: F64 | None = None  # (n, 2): mean and mean square of the carriers in traps behind a walk, with a time constant


def expected_walk(
    automaton: Automaton,
    patterns: NDArray[Any],
    transmission: NDArray[np.floating[Any]],
    law: ClickLaw | CountLaw,
    photons_per_level: float = 1.0,
    *,
    afterpulses: Afterpulses = NO_AFTERPULSES,
    begins: tuple[float, float] = (0.0, 0.0),
    left: NDArray[np.floating[Any]] | None = None,
) -> ExpectedWalk:
    """Return what `automaton` does on each of n objects, exactly.

    `patterns` (n_patterns, pixels) times `photons_per_level` are photoelectrons per exposure and unit transmission, lit all the
    time; `transmission` (n, pixels), 0 to 1. `law` is that of one whole exposure: dark counts and read noise come whatever the dwell.
    Of `afterpulses` without a time constant a click makes the next exposure click as well; the exposure before a walk is taken to have
    none (that of the last object's end is forgotten, at most one click in so many walks). With one, `begins` is the memory with which a
    walk begins, mean and variance, and meeting walks share its moments. `left` (states,) is the part of a state's light that objects
    give back which bleach; None: all.
    Of several channels `law` is that of each. ValueError for shapes that do not fit, a law of other outcomes than the automaton's, and
    afterpulses of a detector that counts or of several channels.
    """
    _check_arguments(automaton, patterns, transmission)
    _check_law(automaton, law, afterpulses)
    n, n_leaves = len(transmission), automaton.n_leaves
    sums, leaves = np.zeros((5, n)), np.empty((n, n_leaves))
    ends = np.empty((n, 2)) if afterpulses.time else None
    step = max(1, _NUMBERS_AT_ONCE // max(len(patterns), len(automaton.posteriors)))
    order = np.argsort(automaton.depth, kind="stable").astype(np.int64)
    slots = np.split(order, np.searchsorted(automaton.depth[order], np.arange(1, automaton.n_slots)))
    shown = patterns.sum(axis=1, dtype=np.float64) * photons_per_level
    for start in range(0, n, step):
        here = slice(start, min(start + step, n))
        light = pattern_light(patterns, transmission[here], photons_per_level)
        walks = _walks(automaton, law, afterpulses, len(light), begins)
        for states in slots:
            rows, share = automaton.rows[states], automaton.dwell[states] / automaton.dwell_steps
            each = light[:, rows] * (share if left is None else share * left[states])[:, None]
            reached, clicks = walks.leave(states, each)
            sums[0, here] += clicks
            sums[1, here] += (reached * each.sum(axis=2)).sum(axis=1)
            sums[2, here] += reached @ (shown[rows].sum(axis=1) * share)
            sums[3, here] += reached.sum(axis=1)
            if states[0] == 0:  # alone in its slot
                sums[4, here] = clicks if automaton.n_outcomes == 2 else 1.0 - outcome_chances(law, each)[0, :, 0]
        leaves[here] = walks.chance[:, :, automaton.n_states :].sum(axis=0)
        if ends is not None and isinstance(walks, _RememberedWalks):
            ends[here] = walks.sums.ends.T
    return ExpectedWalk(sums[0], sums[1], sums[2], sums[3], sums[4], leaves, ends)


def _check_arguments(automaton: Automaton, patterns: NDArray[Any], transmission: NDArray[Any]) -> None:
    if patterns.ndim != 2 or transmission.ndim != 2 or patterns.shape[1] != transmission.shape[1]:
        raise ValueError(f"patterns {patterns.shape} and objects {transmission.shape}, allowed: the same pixels")
    last = int(automaton.pattern.max()) + automaton.channels - 1
    if last >= len(patterns):
        raise ValueError(f"a state shows pattern {last} of {len(patterns)}")
    if len(transmission) * automaton.n_leaves > LEAF_NUMBERS_MAX:
        most = LEAF_NUMBERS_MAX // automaton.n_leaves
        found = f"{len(transmission)} objects and {automaton.n_leaves} leaves"
        raise ValueError(f"{found}, allowed: {most} objects at once")


def _check_law(automaton: Automaton, law: ClickLaw | CountLaw, afterpulses: Afterpulses) -> None:
    outcomes = outcomes_of(law)
    wanted = automaton.n_outcomes if automaton.counts else 2
    if outcomes != wanted or (automaton.n_outcomes > 2 and afterpulses):
        found = f"{outcomes}, afterpulse {afterpulses.probability:g}"
        raise ValueError(
            f"an automaton of {automaton.n_outcomes} outcomes under a law of {found}, allowed: the same outcomes, and no afterpulses "
            "where photons are counted or several channels are read at once"
        )


def pattern_light(patterns: NDArray[Any], transmission: NDArray[Any], scale: float) -> F64:
    """Return photoelectrons, float64 (objects, patterns), with the light on all the time; arguments as in `expected_walk`."""
    wide = transmission.astype(np.float64)
    light = np.empty((len(wide), len(patterns)))
    for start in range(0, len(patterns), _PATTERNS_AT_ONCE):
        part = patterns[start : start + _PATTERNS_AT_ONCE]
        light[:, start : start + _PATTERNS_AT_ONCE] = wide @ part.T.astype(np.float64)
    light *= scale
    return light


def _walks(
    automaton: Automaton, law: ClickLaw | CountLaw, afterpulses: Afterpulses, n: int, begins: tuple[float, float]
) -> _Walks | _AfterpulsedWalks | _RememberedWalks:
    if isinstance(law, ClickLaw) and afterpulses.time:
        return _RememberedWalks(automaton, law, afterpulses, n, begins)
    if isinstance(law, ClickLaw) and afterpulses.probability:
        return _AfterpulsedWalks(automaton, law, afterpulses.probability, n)
    return _Walks(automaton, law, n)


class _Walks:
    """Walks of n objects, carried on slot by slot, whose outcomes depend on nothing before; `chance` is (1, n, nodes)."""

    def __init__(self, automaton: Automaton, law: ClickLaw | CountLaw, n: int) -> None:
        self._automaton, self._law = automaton, law
        self.chance = np.zeros((1, n, len(automaton.posteriors)))
        self.chance[0, :, 0] = 1.0
        numbers = range(automaton.n_outcomes)
        self._clicks = np.array([number if automaton.counts else number.bit_count() for number in numbers], np.float64)

    def leave(self, states: NDArray[np.int64], photoelectrons: F64) -> tuple[F64, F64]:
        """Leave `states` (m,) of one slot, which give `photoelectrons` (n, m, channels).

        Returns the chances with which the objects reached them (n, m), and the expected clicks (n,).
        """
        reached = self.chance[0][:, states]
        chances = outcome_chances(self._law, photoelectrons)
        for outcome, chance in enumerate(chances):
            after = self._automaton.successors[states, outcome]
            _pass_on(self.chance[0], self.chance[0], states, after, np.ascontiguousarray(chance))
        return reached, (reached * np.tensordot(self._clicks, chances, 1)).sum(axis=1)


def outcome_chances(law: ClickLaw | CountLaw, photoelectrons: F64) -> F64:
    """Return the chance of each outcome, (outcomes, n, m), of `photoelectrons` (n, m, channels); no click at all is outcome 0."""
    if isinstance(law, CountLaw):
        return count_chances(law, photoelectrons[:, :, 0])
    return word_chances(*both_chances(law, photoelectrons))


def word_chances(click: F64, miss: F64) -> F64:
    """Return the chance of each outcome, (2**channels, n, m), from those of a click and of none in each channel, (n, m, channels)."""
    chances = np.ones((1, *click.shape[:2]))
    for channel in range(click.shape[2]):
        chances = np.concatenate([chances * miss[:, :, channel], chances * click[:, :, channel]])
    return chances


class _AfterpulsedWalks:
    """Walks as `_Walks`, each click of which makes the next exposure click too, with a probability; `chance` is (2, n, nodes)."""

    def __init__(self, automaton: Automaton, law: ClickLaw, afterpulse: float, n: int) -> None:
        self._automaton, self._law, self._afterpulse = automaton, law, afterpulse
        self.chance = np.zeros((2, n, len(automaton.posteriors)))
        self.chance[0, :, 0] = 1.0

    def leave(self, states: NDArray[np.int64], photoelectrons: F64) -> tuple[F64, F64]:
        """See `_Walks`."""
        reached = self.chance[:, :, states]
        click, miss = both_chances(self._law, photoelectrons[:, :, 0])
        for before, stays in enumerate((1.0, 1.0 - self._afterpulse)):
            for outcome, chance in enumerate((miss * stays, click + miss * (1.0 - stays))):
                after = self._automaton.successors[states, outcome]
                _pass_on(self.chance[before], self.chance[outcome], states, after, chance)
        return reached.sum(axis=0), (reached.sum(axis=0) * click + reached[1] * miss * self._afterpulse).sum(axis=1)


class _Sums(NamedTuple):
    """Chance of each node by the last outcome, its memory and squared memory, float64 (2, n, nodes); and what is left, (2, n)."""

    chance: F64
    memory: F64
    squares: F64
    ends: F64


class _RememberedWalks:
    """Walks as `_Walks` on a detector that remembers several exposures.

    `begins` is the memory, mean and variance, with which every walk begins; the ends are the mean and the mean square of what is left
    when the last slot of a walk is over. The slots behind its leaf are dark.
    """

    def __init__(
        self, automaton: Automaton, law: ClickLaw, afterpulses: Afterpulses, n: int, begins: tuple[float, float]
    ) -> None:
        self._automaton, self._law, self._afterpulses = automaton, law, afterpulses
        nodes = (2, n, len(automaton.posteriors))
        self.sums = _Sums(np.zeros(nodes), np.zeros(nodes), np.zeros(nodes), np.zeros((2, n)))
        self.chance = self.sums.chance
        self.chance[0, :, 0], self.sums.memory[0, :, 0] = 1.0, begins[0]
        self.sums.squares[0, :, 0] = begins[1] + begins[0] ** 2
        self._of_law = np.array([*afterpulses.steps, afterpulses.dead])

    def leave(self, states: NDArray[np.int64], photoelectrons: F64) -> tuple[F64, F64]:
        """See `_Walks`."""
        automaton, mean = self._automaton, -log_no_click(self._law, photoelectrons[:, :, 0])
        reached, clicks = self.chance[:, :, states].sum(axis=0), np.zeros(len(mean))
        behind = automaton.n_slots - 1 - int(automaton.depth[states[0]])
        of_law = np.append(self._of_law, self._afterpulses.dark_flow(behind))
        _pass_memory_on(self.sums, states, automaton.successors, mean, of_law, clicks)
        return reached, clicks


@njit(cache=True, nogil=True)
def _pass_on(source: F64, target: F64, states: NDArray[np.int64], after: NDArray[np.uint32], chance: F64) -> None:
    """Add what leaves `states` (m,) of `source` (n, nodes) by one outcome, of `chance` (n, m), to the nodes `after` (m,) of `target`."""
    for i in range(source.shape[0]):
        for k in range(states.size):
            target[i, after[k]] += source[i, states[k]] * chance[i, k]


@njit(cache=True, nogil=True)
def _pass_memory_on(sums, states, successors, mean, of_law, clicks):  # type: ignore[no-untyped-def]
    """Add what leaves `states` (m,) to its successors in `sums`, with its memory, and the expected clicks to `clicks` (objects,).

    of_law float64 (14,): the steps of `Afterpulses`, its dead time, and its flow through the slots behind. The same as `Afterpulses.after`.
    """
    chance, memory, squares, ends = sums
    n_states = successors.shape[0]
    to_x, of_m, spread_m, spread_x = of_law[0], of_law[1], of_law[2], of_law[3]
    pause_x, pause_m, pause_spread_m, pause_spread_x = of_law[4], of_law[5], of_law[6], of_law[7]
    seen, kept, dead, behind, behind_spread = of_law[8], of_law[9], of_law[11], of_law[12], of_law[13]
    for before in range(2):
        for i in range(mean.shape[0]):
            for k in range(states.size):
                state = states[k]
                reached = chance[before, i, state]
                if reached <= 0.0:
                    continue
                m, x = mean[i, k], memory[before, i, state] / reached
                found, varied = m / (1.0 + dead * m), m / (1.0 + dead * m) ** 3
                variance = max(squares[before, i, state] / reached - x * x, 0.0)
                ratio = seen * variance / max(x, LEAST_MEAN)
                sight = seen * x * (np.log1p(ratio) / ratio if ratio > SMALL_RATIO else 1.0 - ratio / 2.0)
                click, fewer = -np.expm1(-(m + sight)), 1.0 / (1.0 + ratio)
                silent_x, silent_v = x * kept * fewer, variance * (kept * fewer) ** 2
                more_x = of_m * found + x * (to_x - kept) + x * kept * (1.0 - fewer)
                more_v = spread_m * varied + spread_x * x + variance * (to_x**2 - (kept * fewer) ** 2)
                for outcome in range(2):
                    part, here, spread = reached * np.exp(-(m + sight)), silent_x, silent_v
                    if outcome:
                        part, chance_of = reached * click, max(click, LEAST_MEAN)
                        here = silent_x + more_x / chance_of
                        square = silent_x**2 + (more_v + more_x * (2.0 * silent_x + more_x)) / chance_of
                        spread = max(silent_v + square - here**2, 0.0)
                    spread = pause_x**2 * spread + pause_spread_m * varied + pause_spread_x * here
                    here = pause_x * here + pause_m * found
                    after = successors[state, outcome]
                    chance[outcome, i, after] += part
                    memory[outcome, i, after] += part * here
                    squares[outcome, i, after] += part * (spread + here**2)
                    if after >= n_states:
                        ends[0, i] += part * behind * here
                        ends[1, i] += part * (behind**2 * (spread + here**2) + behind_spread * here)
                clicks[i] += reached * click
