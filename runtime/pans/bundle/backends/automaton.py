"""The automaton as a back end: a click word in, walked to its leaf; the class with the largest posterior there out.

Below the confidence that was asked for, the label is `NO_LABEL`. A walk is one shot: its patterns depend on its own clicks, so that
several walks are never fused.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.errors import DamagedFileError, UsageError, as_usage_error
from pans.base.machine import outer
from pans.bundle.automaton import Automaton, DoseCap, capped, log_scores, stopped
from pans.bundle.sensor.facts import Bundle

from .verdict import NO_LABEL, Decider, LookUp, Verdict, Verdicts, checked_counts, demand_golden


@outer
def walk_words(
    successors: NDArray[np.uint32],
    words: NDArray[Any],
    channels: int,
    leaves: NDArray[np.uint32],
    exposures: NDArray[np.uint16],
) -> int:
    """Walk words of outcomes (n, bits) from state 0; return -1, or the first word that holds an impossible number.

    `successors` uint32 (states, outcomes) as in `Automaton`, whose longest walk must fit into a word: number t * channels + k is channel k
    in slot t, a click of 0 or 1, or of one channel a photon number. Writes the leaf of each word to `leaves` (n,) and the exposures of its
    walk to `exposures` (n,).
    """
    n_states = successors.shape[0]
    largest = successors.shape[1] - 1 if channels == 1 else 1
    for i in range(words.shape[0]):
        node, bit = np.int64(0), 0
        while node < n_states:
            outcome = np.int64(0)
            for channel in range(channels):
                number = np.int64(words[i, bit])
                if number < 0 or number > largest:
                    return i
                outcome |= number << channel
                bit += 1
            node = np.int64(successors[node, outcome])
        leaves[i] = node - n_states
        exposures[i] = bit // channels
    return -1


class AutomatonDecider(Decider):
    """Decides by the leaf that a click word reaches; `automaton` is the one that runs, stopped early where that was asked for."""

    name = "automaton"

    def __init__(self, bundle: Bundle, confidence: float = 0.0, dose: DoseCap | None = None) -> None:
        """`confidence` above 0: a walk ends where a class is that sure, and a leaf below it abstains. `dose`: it ends before it brings
        more light than that. UsageError, DamagedFileError."""
        if bundle.automaton is None:
            raise UsageError(f"{bundle.name} has no automaton", remedy="use the back end auto")
        whole = bundle.automaton
        with as_usage_error():
            self.automaton: Automaton = walked_within(bundle, whole, confidence, dose)
        self.confidence, self.dose = confidence, dose
        self.n_features, self.n_classes = self.automaton.n_bits, self.automaton.n_classes
        self.posteriors = self.automaton.posteriors[self.automaton.n_states :]  # of the leaves
        self.labels, self.probabilities = leaf_verdicts(self.automaton, confidence)
        self.look_up = LookUp(self.labels, self.probabilities, np.zeros(self.n_features, np.int64))
        self._leaf, self._exposures = np.zeros(1, np.uint32), np.zeros(1, np.uint16)
        self._one = np.zeros((1, self.n_features), np.int64)
        self._demand_golden(bundle, whole)
        self.decide(self._one[0].copy(), 1)

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """Decide from the outcomes of one walk, int64 (d_f,); UsageError for impossible ones, and for several shots."""
        demand_one_shot(shots)
        self._one[0] = counts
        automaton = self.automaton
        if walk_words(automaton.successors, self._one, automaton.channels, self._leaf, self._exposures) >= 0:
            raise UsageError(f"an automaton answers numbers of 0 to {automaton.largest}, not {counts.tolist()}")
        return self.decide_leaf(int(self._leaf[0]))

    def decide_leaf(self, leaf: int) -> Verdict:
        """Return what leaf number `leaf` decides; IndexError beyond."""
        return Verdict(int(self.labels[leaf]), float(self.probabilities[leaf]))

    def leaves(self, counts: ArrayLike, shots: int = 1) -> tuple[NDArray[np.uint32], NDArray[np.uint16]]:
        """Return the leaf and the exposures of each walk, (n,), of outcomes, integers (n, d_f); ValueError for impossible ones."""
        demand_one_shot(shots)
        return _walked(self.automaton, checked_counts(counts, self.automaton.largest, self.n_features))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return log posteriors, float32 (n, classes), at least log(1e-30), of clicks (n, d_f)."""
        return log_scores(self.posteriors[self.leaves(counts, shots)[0]])

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """Return the labels, int64 (n,), `NO_LABEL` below the confidence, of clicks (n, d_f)."""
        return self.labels[self.leaves(counts, shots)[0]].astype(np.int64)

    def verdicts(self, counts: ArrayLike, shots: int) -> Verdicts:
        """Return labels and probabilities of clicks (n, d_f)."""
        leaf = self.leaves(counts, shots)[0]
        return Verdicts(self.labels[leaf], self.probabilities[leaf])

    def _demand_golden(self, bundle: Bundle, whole: Automaton) -> None:
        walks = bundle.golden_walks
        if walks is None:
            raise DamagedFileError(f"{bundle.name}: an automaton without golden walks")
        found = _walked(whole, bundle.golden_means.astype(np.int64))[0] + np.uint32(whole.n_states)
        if not np.array_equal(found, walks[:, -1]):
            row = int((found != walks[:, -1]).argmax())
            where = f"golden walk {row} ends at leaf {found[row] - whole.n_states} here"
            raise DamagedFileError(f"{bundle.name}: {where}", remedy="export the bundle again")
        demand_golden(self.name, log_scores(whole.posteriors[walks[:, -1]]), bundle.golden_scores, bundle)


def walked_within(bundle: Bundle, automaton: Automaton, confidence: float, dose: DoseCap | None) -> Automaton:
    """Return the automaton that really runs: `automaton` of `bundle` where it stops by confidence (0: never) and within a dose."""
    found = stopped(automaton, confidence) if confidence else automaton
    return found if dose is None else capped(found, bundle.light_of(found), dose.most, dose.states)


def leaf_verdicts(automaton: Automaton, confidence: float) -> Verdicts:
    """Return the label of each leaf, uint16 (`NO_LABEL` where its posterior stays below `confidence`), and the posterior's maximum."""
    posteriors = automaton.posteriors[automaton.n_states :]
    labels, probabilities = posteriors.argmax(axis=1).astype(np.uint16), posteriors.max(axis=1)
    return Verdicts(np.where(probabilities >= np.float32(confidence), labels, np.uint16(NO_LABEL)), probabilities)


def _walked(automaton: Automaton, words: NDArray[np.int64]) -> tuple[NDArray[np.uint32], NDArray[np.uint16]]:
    leaves, exposures = np.empty(len(words), np.uint32), np.empty(len(words), np.uint16)
    bad = walk_words(automaton.successors, words, automaton.channels, leaves, exposures)
    if bad >= 0:
        raise ValueError(f"click word {bad} holds other numbers than 0 to {automaton.largest}")
    return leaves, exposures


def demand_one_shot(shots: int) -> None:
    """Raise UsageError for several shots per decision."""
    if shots != 1:
        what = f"an automaton decides on one walk, not on {shots} shots: what it shows depends on its own clicks"
        raise UsageError(what, remedy="use --shots 1; --trials gives several walks per object, each a decision")
