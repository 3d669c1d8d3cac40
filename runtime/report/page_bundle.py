"""The report page of a bundle, and the pictures of its patterns or optics.

Owns what stands on it; never draws (figures.py).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import Bundle

from . import figures as draw
from .file_facts import file_facts
from .page import Page


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


def add_optics(page: Page, bundle: Bundle) -> None:
    """Add the patterns that are shown, or the rows of the passive optics."""
    if bundle.automaton is not None:
        _add_automaton(page, bundle, bundle.automaton)
        return
    if bundle.analyser is None:
        pictures = bundle.patterns().reshape(-1, *bundle.image_shape)
        more = (
            ""
            if len(pictures) <= draw.PATTERNS_MAX
            else f" The first {draw.PATTERNS_MAX} of {len(pictures)} are drawn."
        )
        page.figure(
            draw.patterns(pictures, "photoelectrons per exposure\nand unit transmission"),
            f"The patterns as they are shown, in {bundle.levels} whole levels.{more}",
        )
        page.figure(
            draw.per_pattern(pictures.sum(axis=(1, 2)), "photoelectrons at\ntransmission 1"),
            f"Light of each pattern; together {bundle.illumination():.4g}, the illumination of one shot.",
        )
        return
    matrix = bundle.analyser.matrix.reshape(-1, *bundle.image_shape)
    values, unit = (np.abs(matrix), "modulus of W") if np.iscomplexobj(matrix) else (matrix, "W")
    page.figure(draw.patterns(values.astype(np.float64), unit), f"The rows of W, {bundle.encoder}: one per detector.")


def _add_automaton(page: Page, bundle: Bundle, automaton: Automaton) -> None:
    """Add the patterns of the first states, how many states each slot has, and how sure states and leaves are."""
    states = automaton.pattern[: draw.PATTERNS_MAX]
    shown = bundle.pattern_levels[states].astype(np.float64)
    shown /= np.maximum(shown.max(axis=1, keepdims=True), 1.0)
    page.figure(
        draw.patterns(shown.reshape(-1, *bundle.image_shape), "share of the pattern's\nbrightest pixel"),
        f"What the first {len(states)} of {automaton.n_states} states show, each pattern by its own brightest pixel; every walk begins in "
        f"state 0. {bundle.n_patterns} patterns in {bundle.levels} whole levels.",
    )
    sure = automaton.posteriors.max(axis=1)
    states = sure[: automaton.n_states]
    slots = [states[automaton.depth == slot] for slot in range(automaton.n_slots)]
    page.figure(
        draw.states_by_slot(slots, sure[automaton.n_states :]),
        f"States of each slot, and the largest probability in their posteriors; on the right that of the {automaton.n_leaves} leaves.",
    )
