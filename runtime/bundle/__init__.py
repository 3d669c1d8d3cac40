"""The trained artifact in one file: patterns in projector levels or passive optics, the back end, golden vectors, provenance.

Owns what a bundle is, its bytes (docs/reference/formats.md) and every check of them. A bundle that was read is whole and consistent, or
the read has raised. It shows no pattern and decides nothing (decide); training and export are the trainer's.
"""

from .model import BackEnd, Bundle, Shown, bundle_bytes, load_bundle, make_bundle, parse_bundle, write_bundle
from .optics import Analyser

__all__ = [
    "Analyser",
    "BackEnd",
    "Bundle",
    "Shown",
    "bundle_bytes",
    "load_bundle",
    "make_bundle",
    "parse_bundle",
    "write_bundle",
]
