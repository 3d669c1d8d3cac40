"""The report page's part on an automaton's walks: the tree of their first steps, their lengths, how sure their decisions were.

Owns the sums behind the drawings, from recorded clicks and decisions; never draws (figures.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import DecisionFlag
from pans.runtime.record import Recording

from . import figures as draw
from .page import Page
from .page_rates import Rates

TREE_LEVELS = 4
TREE_STATES = 15  # of a tree that can be looked at
CONFIDENCE_BINS = 10
_NOT_WALKED = int(DecisionFlag.GAP | DecisionFlag.WRONG_PATTERN | DecisionFlag.INCOMPLETE)


def add_walks(page: Page, recording: Recording, bundle: Bundle, automaton: Automaton, rates: Rates) -> None:
    """Add what a run's walks were like; `automaton` is the one that ran, of `bundle`'s patterns."""
    decisions = recording.decisions()
    whole = decisions[(decisions["flags"] & _NOT_WALKED) == 0]
    page.heading("Walks")
    if not len(whole):
        page.text("No walk has come to its leaf.", "note")
        return
    nodes = _first_states(automaton)
    pictures = bundle.pattern_levels[automaton.pattern[nodes]].astype(np.float64) / (bundle.levels - 1)
    pictures *= (automaton.dwell[nodes] / automaton.dwell_steps)[:, None]
    page.figure(
        draw.tree(pictures.reshape(-1, *bundle.image_shape), _tree_of(automaton, nodes, rates)),
        "The first steps of the walks, as the run went: each state's pattern (brightness times the time that it is on), which share of the "
        "walks came there, and how often it clicked. Grey ways are those without a click, red ones those with one; where several meet, the "
        "state is drawn once.",
    )
    page.figure(
        draw.lengths(
            np.bincount(whole["exposures"], minlength=automaton.n_slots + 1)[1:], np.bincount(whole["clicks"])
        ),
        f"Exposures and clicks of {len(whole)} whole walks: {whole['exposures'].mean():.2f} exposures of {automaton.n_slots} at most, "
        f"{whole['clicks'].mean():.2f} clicks on average.",
    )
    _add_confidence(page, whole)


def _add_confidence(page: Page, whole: NDArray[np.void]) -> None:
    known = whole[(whole["truth"] >= 0) & ((whole["flags"] & int(DecisionFlag.ABSTAINED)) == 0)]
    said = f"of the decisions, {whole['probability'].mean():.3f} on average"
    if not len(known):
        page.text(
            f"The probability {said}; the true classes are not in the decision log: how sure they should be is not known."
        )
        return
    bins = _reliability(known["probability"], known["label"] == known["truth"])
    error = sum(share * abs(accuracy - probability) for probability, accuracy, share in bins)
    page.figure(
        draw.reliability(bins, f"{len(known)} decisions"),
        f"Share of right decisions against the probability that they stated ({said}). The difference, weighted by the decisions in each "
        f"bin, is {error:.3f}; so few decisions give about {_chance_error(bins, len(known)):.3f} by chance alone.",
    )


def _reliability(probability: NDArray[np.float32], right: NDArray[np.bool_]) -> list[tuple[float, float, float]]:
    """Mean probability, share of right ones and share of all, of each bin that has any."""
    place = np.minimum((probability * CONFIDENCE_BINS).astype(np.int64), CONFIDENCE_BINS - 1)
    return [
        (float(probability[here].mean()), float(right[here].mean()), float(here.mean()))
        for here in (place == number for number in range(CONFIDENCE_BINS))
        if here.any()
    ]


def _chance_error(bins: list[tuple[float, float, float]], n: int) -> float:
    """The mean of that difference if every stated probability were right: of a share of m decisions sqrt(2 p (1 - p) / (pi m))."""
    return float(sum(share * np.sqrt(2 * p * (1 - p) / (np.pi * share * n)) for p, _, share in bins))


def _first_states(automaton: Automaton) -> NDArray[np.int64]:
    """The states of the first steps, as many levels as can be looked at."""
    for levels in range(TREE_LEVELS, 0, -1):
        nodes = np.flatnonzero(automaton.depth < levels)
        if len(nodes) <= TREE_STATES or levels == 1:
            break
    return nodes


def _tree_of(automaton: Automaton, nodes: NDArray[np.int64], rates: Rates) -> list[draw.TreeNode]:
    place = {int(node): number for number, node in enumerate(nodes)}
    walks = max(float(rates.state_exposures[0]), 1.0)
    found = []
    for node in nodes.tolist():
        exposures, clicks = float(rates.state_exposures[node]), float(rates.state_clicks[node])
        leads = tuple(place.get(int(successor), -1) for successor in automaton.successors[node])
        rate = clicks / exposures if exposures else float("nan")
        found.append(draw.TreeNode(node, int(automaton.depth[node]), exposures / walks, rate, leads))
    return found
