"""The report page's part on an automaton's walks: the tree of their first steps, their lengths, how sure their decisions were.

Owns the sums behind the drawings, from recorded clicks and decisions; the tree is tree.py's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import DecisionFlag
from pans.runtime.record import Recording

from .bundle import clicked_words, outcomes, state_picture
from .charts import Axis, Bars, Chart, Curve, percent
from .page import Page
from .rates import Rates
from .tree import Tree, TreeNode

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
    exposures = np.bincount(whole["exposures"], minlength=automaton.n_slots + 1)[1:]
    page.figure(
        tree_drawing(bundle, automaton, nodes, rates),
        "The first steps of the walks, as the run went: each state's pattern (by its own brightest pixel), which share of the walks "
        "came there, and how often it clicked. Solid ways are those after a click, dashed ones those without; where several "
        "meet, the state is drawn once.",
    )
    if automaton.counts:
        last = automaton.n_outcomes - 1
        page.text(
            f"An exposure is a photon number from 0 to {last} (or more). Clicks of a walk are the photons counted.",
            "note",
        )
    if automaton.channels > 1:
        page.text(
            f"A state shows {automaton.channels} patterns at once, side by side here, each to a detector of its own; how often it clicked "
            "counts exposures in which any of them did.",
            "note",
        )
    page.table(
        _meanings(automaton, nodes, bundle, rates),
        ("state", "walks", "clicked", *_after(automaton)),
    )
    page.figure(
        _counted("exposures of a walk", exposures, 1),
        f"Exposures and clicks of {len(whole)} whole walks: {whole['exposures'].mean():.2f} exposures of {automaton.n_slots} at most, "
        f"{whole['clicks'].mean():.2f} clicks on average.",
    )
    page.figure(_counted("clicks of a walk", np.bincount(whole["clicks"]), 0), "Clicks of the same walks.")
    _add_confidence(page, whole)


def _after(automaton: Automaton) -> tuple[str, ...]:
    """The heads of the classes after each outcome, in the order of `outcomes`."""
    if automaton.channels > 1:
        words = reversed(range(1, automaton.n_outcomes))
        return (*(f"after {clicked_words(word, automaton.channels)}" for word in words), "without a click")
    if not automaton.counts:
        return "most probable after a click", "without a click"
    last = automaton.n_outcomes - 1
    return (f"most probable after {last} photons or more", *(f"after {number}" for number in reversed(range(last))))


def _counted(what: str, counts: NDArray[np.int64], first: int) -> Chart:
    """How many walks had each number of something."""
    edges = first + np.arange(len(counts) + 1) - 0.5
    return Chart(
        label=f"How many walks had each number of {what}",
        x=Axis(what, float(edges[0]), float(edges[-1]), text=lambda value: f"{value:.0f}"),
        y=Axis("walks", 0.0, 1.05 * max(int(counts.max(initial=0)), 1)),
        bars=[Bars(edges, counts)],
        height=170,
    )


def _meanings(automaton: Automaton, nodes: NDArray[np.int64], bundle: Bundle, rates: Rates) -> list[tuple[str, ...]]:
    """What a click in each of the first states says: the most probable class after either outcome."""
    rows = []
    for node in _tree_of(automaton, nodes, rates):
        clicked = "never shown" if np.isnan(node.rate) else f"{100 * node.rate:.1f} %"
        said = [text.partition(": ")[2] for text in outcomes(automaton, node.state, bundle.classes)]
        rows.append((str(node.state), f"{100 * node.share:.0f} %", clicked, *said))
    return rows


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
        _reliability_chart(bins),
        f"Share of right decisions against the probability that they stated ({said}). The difference, weighted by the decisions in each "
        f"bin, is {error:.3f}; so few decisions give about {_chance_error(bins, len(known)):.3f} by chance alone.",
    )


def _reliability_chart(bins: list[tuple[float, float, float]]) -> Chart:
    probability, accuracy, _ = np.array(bins).T
    return Chart(
        label="Share of right decisions against the probability that they stated",
        x=Axis("probability that the decision stated", 0.0, 1.0, text=percent),
        y=Axis("share of right decisions", 0.0, 1.0, text=percent),
        curves=[Curve([0.0, 1.0], [0.0, 1.0], "as sure as right", "b"), Curve(probability, accuracy, "decisions", "a")],
        height=260,
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


def tree_drawing(bundle: Bundle, automaton: Automaton, nodes: NDArray[np.int64], rates: Rates) -> Tree:
    """Return the tree of the first states with their patterns."""
    pictures = np.stack([state_picture(bundle, automaton, node) for node in nodes.tolist()])
    return Tree(_tree_of(automaton, nodes, rates), pictures)


def _tree_of(automaton: Automaton, nodes: NDArray[np.int64], rates: Rates) -> list[TreeNode]:
    place = {int(node): number for number, node in enumerate(nodes)}
    walks = max(float(rates.state_exposures[0]), 1.0)
    found = []
    for node in nodes.tolist():
        exposures, clicks = float(rates.state_exposures[node]), float(rates.state_clicks[node])
        leads = tuple(place.get(int(successor), -1) for successor in automaton.successors[node])
        rate = clicks / exposures if exposures else float("nan")
        found.append(TreeNode(node, int(automaton.depth[node]), exposures / walks, rate, leads))
    return found
