"""The frontier: accuracy against photons, clicks, exposures and illumination, of automata and of everything they are compared with.

Owns three pages of `pans reproduce`: `reaching`, what passive rows need at the optics (reaching.py), `one-photon`, the bound of what one
photon tells (one_photon.py), and `frontier`: its ways to decide and their recipes, what measures a row, the tables made of the rows alone,
and the pictures that explain an automaton. A row is of one task, way, level and seed; finished rows lie in the cache folder, what is not
measured yet is named on the page and found again at the next start. All figures are SIMULATED, on an ideal detector.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .page import PAGES

__all__ = ["NAMES", "PAGES"]

NAMES = ("frontier", "reaching", "one-photon")  # of the pages, known without importing torch

__getattr__ = lazy_names(__name__, {"PAGES": ".page"})
