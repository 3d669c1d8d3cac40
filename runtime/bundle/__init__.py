"""A trained sensor in one file: patterns or passive optics, what decides (head, table or automaton), golden vectors, provenance.

`load_bundle` reads a file or a shipped bundle by name, `make_bundle` makes one from arrays and an ONNX head, `write_bundle` writes it.
Start reading in facts.py (what a bundle is), then format.py (its bytes, docs/reference/formats.md) and automaton.py.
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
