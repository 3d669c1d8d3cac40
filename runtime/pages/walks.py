"""The section on an automaton's walks, from recorded clicks and decisions: the tree of their first steps, lengths, and reliability."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import DecisionFlag
from pans.runtime.record import Recording
from pans.runtime.record.recording import together

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
    walks = _sum_walks(recording, automaton)
    page.heading("Walks")
    if not walks.n:
        page.text("No walk has come to its leaf.", "note")
        return
    nodes = _first_states(automaton)
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
        _counted("exposures of a walk", walks.exposures[1:], 1),
        f"Exposures and clicks of {walks.n} whole walks: {_mean(walks.exposures):.2f} exposures of {automaton.n_slots} at most, "
        f"{_mean(walks.clicks):.2f} clicks on average.",
    )
    page.figure(_counted("clicks of a walk", walks.clicks, 0), "Clicks of the same walks.")
    _add_confidence(page, walks)


class WalkSums(NamedTuple):
    """How many whole walks had each number of exposures and of clicks, and what they said of themselves."""

    exposures: NDArray[np.int64]
    clicks: NDArray[np.int64]
    probability: float  # their sum
    bins: NDArray[np.float64]  # (3, CONFIDENCE_BINS) of those with label and truth: how many, probabilities, right ones

    @property
    def n(self) -> int:
        """Whole walks."""
        return int(self.exposures.sum())

    @property
    def reliability(self) -> list[tuple[float, float, float]]:
        """Mean probability, share of right ones and share of all, of each bin that has any."""
        n = self.bins[0].sum()
        return [(said / count, right / count, count / n) for count, said, right in self.bins.T.tolist() if count]


def _sum_walks(recording: Recording, automaton: Automaton) -> WalkSums:
    sums = WalkSums(
        np.zeros(automaton.n_slots + 1, np.int64), np.zeros(1, np.int64), 0.0, np.zeros((3, CONFIDENCE_BINS))
    )
    for rows in together(recording.iter_decisions()):
        whole = rows[(rows["flags"] & _NOT_WALKED) == 0]
        known = whole[(whole["truth"] >= 0) & ((whole["flags"] & int(DecisionFlag.ABSTAINED)) == 0)]
        place = np.minimum((known["probability"] * CONFIDENCE_BINS).astype(np.int64), CONFIDENCE_BINS - 1)
        for row, weights in enumerate((None, known["probability"], known["label"] == known["truth"])):
            sums.bins[row] += np.bincount(place, weights, CONFIDENCE_BINS)
        sums = sums._replace(
            exposures=_added(sums.exposures, whole["exposures"]),
            clicks=_added(sums.clicks, whole["clicks"]),
            probability=sums.probability + float(whole["probability"].sum(dtype=np.float64)),
        )
    return sums


def _added(counts: NDArray[np.int64], values: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return `counts` with how often each of `values` is there; longer where they are larger."""
    more = np.bincount(values, minlength=len(counts))
    more[: len(counts)] += counts
    return more


def _mean(counts: NDArray[np.int64]) -> float:
    return float((np.arange(len(counts)) * counts).sum() / counts.sum())


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


def _add_confidence(page: Page, walks: WalkSums) -> None:
    n, said = int(walks.bins[0].sum()), f"of the decisions, {walks.probability / walks.n:.3f} on average"
    if not n:
        page.text(
            f"The probability {said}; the true classes are not in the decision log: how sure they should be is not known."
        )
        return
    bins = walks.reliability
    error = sum(share * abs(accuracy - probability) for probability, accuracy, share in bins)
    page.figure(
        _reliability_chart(bins),
        f"Share of right decisions against the probability that they stated ({said}). The difference, weighted by the decisions in each "
        f"bin, is {error:.3f}; so few decisions give about {_chance_error(bins, n):.3f} by chance alone.",
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
