"""An automaton's walks, from decisions as they come and from a run's rates: the tree of their first steps, lengths, and reliability."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import DecisionFlag

from .bundle import outcomes, state_picture
from .charts import Axis, Bars, Curve, Node, chart, percent, tree, whole
from .rates import Rates

TREE_LEVELS, TREE_STATES = 4, 15  # that can be looked at
CONFIDENCE_BINS = 10
_NOT_WALKED = int(DecisionFlag.GAP | DecisionFlag.WRONG_PATTERN | DecisionFlag.INCOMPLETE)
I64 = NDArray[np.int64]


class Walks:
    """How many whole walks had each number of exposures and of clicks, int64 (numbers,), and what they said of themselves."""

    def __init__(self, automaton: Automaton) -> None:
        self._automaton = automaton
        self.exposures, self.clicks = np.zeros(automaton.n_slots + 1, np.int64), np.zeros(1, np.int64)
        self.probability = 0.0  # their sum
        self.bins = np.zeros((3, CONFIDENCE_BINS))  # of those with label and truth: how many, probabilities, right ones

    def take(self, rows: NDArray[np.void]) -> None:
        """Take the next rows, DECISION_DTYPE (n,)."""
        some = rows[(rows["flags"] & _NOT_WALKED) == 0]
        known = some[(some["truth"] >= 0) & ((some["flags"] & int(DecisionFlag.ABSTAINED)) == 0)]
        place = np.minimum((known["probability"] * CONFIDENCE_BINS).astype(np.int64), CONFIDENCE_BINS - 1)
        for row, weights in enumerate((None, known["probability"], known["label"] == known["truth"])):
            self.bins[row] += np.bincount(place, weights, CONFIDENCE_BINS)
        self.exposures, self.clicks = _added(self.exposures, some["exposures"]), _added(self.clicks, some["clicks"])
        self.probability += float(some["probability"].sum(dtype=np.float64))

    def reliability(self) -> list[tuple[float, float, float]]:
        """Return mean probability, share of right ones and share of all, of each bin that has any."""
        n = self.bins[0].sum()
        return [(said / count, right / count, count / n) for count, said, right in self.bins.T.tolist() if count]

    def facts(self, bundle: Bundle, rates: Rates) -> dict[str, Any]:
        """Return what the page says of the walks; {} without any."""
        n, automaton = int(self.exposures.sum()), self._automaton
        if not n:
            return {}
        states = first_states(automaton)
        bins, told = self.reliability(), float(self.bins[0].sum())
        return {
            "n": n,
            "automaton": automaton,
            "tree": tree(
                "The first steps of the walks as a tree of patterns", tree_of(automaton, states, bundle, rates)
            ),
            "head": list(outcomes(automaton, 0, bundle.classes)),
            "rows": [_meaning(automaton, state, bundle, rates) for state in states.tolist()],
            "means": [float(np.average(np.arange(len(one)), weights=one)) for one in (self.exposures, self.clicks)],
            "lengths": _counted("exposures of a walk", self.exposures[1:], 1),
            "clicks": _counted("clicks of a walk", self.clicks, 0),
            "probability": self.probability / n,
            "reliability": _reliability_chart(bins) if bins else None,
            "error": sum(share * abs(right - said) for said, right, share in bins),
            # if every stated probability were right: of a share of m decisions sqrt(2 p (1 - p) / (pi m))
            "chance": sum(share * float(np.sqrt(2 * p * (1 - p) / (np.pi * share * told))) for p, _, share in bins),
        }


def _added(counts: I64, values: NDArray[np.integer[Any]]) -> I64:
    """Return `counts` with how often each of `values` is there; longer where they are larger."""
    more = np.bincount(values, minlength=len(counts))
    more[: len(counts)] += counts
    return more


def _counted(what: str, counts: I64, first: int) -> Any:
    edges = first + np.arange(len(counts) + 1) - 0.5
    x = Axis(what, float(edges[0]), float(edges[-1]), text=whole)
    y = Axis("walks", 0.0, 1.05 * max(int(counts.max(initial=0)), 1))
    return chart(f"How many walks had each number of {what}", x, y, bars=[Bars(edges, counts)], height=190)


def _reliability_chart(bins: list[tuple[float, float, float]]) -> Any:
    said, right, _ = np.array(bins).T
    x, y = (
        Axis("probability that the decision stated", 0.0, 1.0, text=percent),
        Axis("share of right decisions", 0.0, 1.0, text=percent),
    )
    curves = [Curve([0.0, 1.0], [0.0, 1.0], "as sure as right", "b"), Curve(said, right, "decisions", "a")]
    return chart("Share of right decisions against the probability that they stated", x, y, curves=curves, height=270)


def first_states(automaton: Automaton) -> I64:
    """Return the states of the first steps, as many levels as can be looked at."""
    for levels in range(TREE_LEVELS, 0, -1):
        states = np.flatnonzero(automaton.depth < levels)
        if len(states) <= TREE_STATES or levels == 1:
            break
    return states


def _meaning(automaton: Automaton, state: int, bundle: Bundle, rates: Rates) -> tuple[str, ...]:
    """State, share of the walks that came there, how often it clicked, and the most probable class after each outcome."""
    share, rate = _seen(state, rates)
    clicked = "never shown" if rate is None else f"{100 * rate:.1f} %"
    return (str(state), f"{100 * share:.0f} %", clicked, *outcomes(automaton, state, bundle.classes).values())


def _seen(state: int, rates: Rates) -> tuple[float, float | None]:
    """The share of the walks that came to a state, and its clicks per exposure."""
    exposures = float(rates.state_exposures[state])
    share = exposures / max(float(rates.state_exposures[0]), 1.0)
    return share, float(rates.state_clicks[state]) / exposures if exposures else None


def tree_of(automaton: Automaton, states: I64, bundle: Bundle, rates: Rates) -> list[Node]:
    """Return the first states as nodes; each stands below the middle of those that lead to it."""
    number = {int(state): place for place, state in enumerate(states)}
    nodes: dict[int, Node] = {}
    wanted: dict[int, list[float]] = {0: [0.5]}
    for level in range(int(automaton.depth[states].max()) + 1):
        here = [state for state in states.tolist() if automaton.depth[state] == level]
        here.sort(key=lambda state: float(np.mean(wanted.get(state, [0.5]))))
        for side, state in enumerate(here):
            share, rate = _seen(state, rates)
            place, leads = (side + 0.5) / len(here), [int(one) for one in automaton.successors[state]]
            for outcome, lead in enumerate(leads):
                wanted.setdefault(lead, []).append(place + (outcome - 0.5) * 1e-3)
            lines = f"{100 * share:.0f} %", "never" if rate is None else f"{100 * rate:.0f} %"
            picture = state_picture(bundle, automaton, state)
            nodes[state] = Node(level, place, picture, lines, tuple(number.get(lead, -1) for lead in leads))
    return [nodes[state] for state in states.tolist()]
