"""The trained artifact in one file: patterns or passive optics, what decides (head, table or automaton), golden vectors, provenance.

Owns what a bundle is, its bytes (docs/reference/formats.md) and every check of them. A bundle that was read is whole and consistent, or
the read has raised. It shows no pattern and decides nothing (decide); training and export are the trainer's.
"""

from .automaton import Automaton, reachable_automaton, stopped
from .model import (
    BackEnd,
    Bundle,
    Shown,
    bundle_bytes,
    load_bundle,
    make_bundle,
    parse_bundle,
    with_expected,
    write_bundle,
)
from .optics import Analyser

__all__ = [
    "Analyser",
    "Automaton",
    "BackEnd",
    "Bundle",
    "Shown",
    "bundle_bytes",
    "load_bundle",
    "make_bundle",
    "parse_bundle",
    "reachable_automaton",
    "stopped",
    "with_expected",
    "write_bundle",
]
