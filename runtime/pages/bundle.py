"""The report page of a bundle, and the pictures of its patterns or optics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import Bundle
from pans.runtime.report.file_facts import file_facts

from .charts import Axis, Bars, Chart, Curve, percent
from .page import Page, Picture
from .patterns import add_patterns, grey_png
from .rates import Rates

STATES_SHOWN = 24
_BESIDE = "the patterns of its channels side by side,"


def bundle_page(bundle: Bundle, sha256: str, path: Path) -> bytes:
    """Return the page of a bundle: what it is, its patterns or optics, where it comes from."""
    page = Page(f"Bundle {bundle.name}", simulated=False)
    page.text(
        "A trained sensor: what is shown or stands before the detectors, and how clicks become a decision.", "note"
    )
    facts = file_facts(path)
    provenance = facts.pop("provenance", {})
    page.facts(facts)
    page.heading("Optics" if bundle.analyser is not None else "Patterns" if bundle.automaton is None else "Automaton")
    add_optics(page, bundle)
    page.heading("Provenance")
    page.facts({"SHA-256": sha256, **provenance})
    return page.html()


def add_optics(page: Page, bundle: Bundle, rates: Rates | None = None) -> None:
    """Add the patterns that are shown, or the rows of the passive optics, with what a click on each means where a run tells."""
    if bundle.automaton is None:
        add_patterns(page, bundle, rates)
    else:
        _add_automaton(page, bundle, bundle.automaton)


def _add_automaton(page: Page, bundle: Bundle, automaton: Automaton) -> None:
    """Add the patterns of the first states with what a click means there, how many states each slot has, and how sure they are."""
    pictures = []
    for state in range(min(STATES_SHOWN, automaton.n_states)):
        values = state_picture(bundle, automaton, state)
        lines = [f"step {int(automaton.depth[state]) + 1}", *outcomes(automaton, state, bundle.classes)]
        pictures.append(Picture(grey_png(values, 0.0, float(values.max()) or 1.0), f"state {state}", lines))
    page.pictures(
        pictures,
        f"What the first {len(pictures)} of {automaton.n_states} states show, {_BESIDE if automaton.channels > 1 else 'each pattern'} by "
        "its own brightest pixel, and the most "
        f"probable class after a click and without one. Every walk begins in state 0. "
        f"{bundle.n_patterns} patterns in {bundle.levels} whole levels.",
    )
    sure = automaton.posteriors.max(axis=1)
    of_states = sure[: automaton.n_states]
    slots = [of_states[automaton.depth == slot] for slot in range(automaton.n_slots)]
    edges = np.arange(len(slots) + 1) + 0.5
    step = Axis("step of the walk", 0.5, len(slots) + 0.5, text=lambda value: f"{value:.0f}")
    counts = [len(values) for values in slots]
    page.figure(
        Chart(
            label="Number of states in each step",
            x=step,
            y=Axis("states", 0.0, 1.05 * max(counts)),
            bars=[Bars(edges, counts)],
            height=170,
        ),
        "How many states each step of the walk has.",
    )
    low, middle, high = np.array([np.quantile(values, (0.25, 0.5, 0.75)) for values in slots]).T
    page.figure(
        Chart(
            label="Largest probability of a class in the states of each step",
            x=step,
            y=Axis("largest probability", 0.0, 1.0, text=percent),
            curves=[Curve(np.arange(1, len(slots) + 1), middle, low=low, high=high)],
            height=190,
        ),
        "How sure the states of each step are: median and middle half of the largest probability in their posteriors. Of the "
        f"{automaton.n_leaves} leaves, where walks end, the median is {100 * float(np.median(sure[automaton.n_states :])):.1f} %.",
    )


def clicked_words(word: int, channels: int) -> str:
    """Return which channels clicked in an outcome, in words.

    >>> clicked_words(0, 2), clicked_words(2, 2), clicked_words(3, 2)
    ('no click', 'click on 1', 'clicks on 0, 1')
    """
    clicked = [str(channel) for channel in range(channels) if word >> channel & 1]
    return f"click{'s' * (len(clicked) > 1)} on {', '.join(clicked)}" if clicked else "no click"


def state_picture(bundle: Bundle, automaton: Automaton, state: int) -> NDArray[np.float64]:
    """Return what a state shows, in levels, float64 (height, width); of several channels their patterns side by side, a line between."""
    parts = bundle.pattern_levels[automaton.rows[state]].astype(np.float64).reshape(-1, *bundle.image_shape)
    line = np.full((bundle.image_shape[0], 1), parts.max())
    pieces = [piece for part in parts for piece in (line, part)]
    return np.concatenate(pieces[1:], axis=1)


def outcomes(automaton: Automaton, state: int, classes: tuple[str, ...]) -> list[str]:
    """Return the most probable class after each outcome of an exposure in `state`."""
    named: tuple[str, ...] = ("no click", "click") if automaton.n_outcomes == 2 else ()
    if automaton.counts:
        last = automaton.n_outcomes - 1
        named = (*(f"{number} photons" for number in range(last)), f"{last} or more")
    elif automaton.channels > 1:
        named = tuple(clicked_words(word, automaton.channels) for word in range(automaton.n_outcomes))
    lines = []
    for outcome, words in reversed(list(enumerate(named))):
        after = automaton.posteriors[int(automaton.successors[state, outcome])]
        best = int(after.argmax())
        lines.append(f"{words}: {classes[best]} {100 * float(after[best]):.0f} %")
    return lines
