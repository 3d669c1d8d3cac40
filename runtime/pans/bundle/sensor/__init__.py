"""A bundle: its facts, its file, its passive optics.

`load_bundle` reads a file or a shipped bundle by name, `make_bundle` makes one from arrays and an ONNX head, `write_bundle` writes it.
Start at facts.py (what a bundle is), then file_format.py (its bytes, docs/reference/formats.md).
"""

from .analyser import Analyser, Light, Optics, amplification, incident_field, incident_intensity, scatter
from .bundle import BackEnd, Shown, bundle_path, load_bundle, make_bundle, with_expected, word_means, write_bundle
from .facts import (
    GOLDEN_TOLERANCE,
    GOLDEN_WORK_MAX,
    Bundle,
    check_bundle,
    expected_differences,
    frozen,
    golden_violation,
)
from .file_format import MAGIC, bundle_bytes, parse_bundle, read_bundle

__all__ = [
    "GOLDEN_TOLERANCE",
    "GOLDEN_WORK_MAX",
    "MAGIC",
    "Analyser",
    "BackEnd",
    "Bundle",
    "Light",
    "Optics",
    "Shown",
    "amplification",
    "bundle_bytes",
    "bundle_path",
    "check_bundle",
    "expected_differences",
    "frozen",
    "golden_violation",
    "incident_field",
    "incident_intensity",
    "load_bundle",
    "make_bundle",
    "parse_bundle",
    "read_bundle",
    "scatter",
    "with_expected",
    "word_means",
    "write_bundle",
]
