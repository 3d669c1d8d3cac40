"""The choices of a baseline: which paradigm, which method, and how it is measured.

Owns names and defaults; imports nothing, so that a command line can name the methods at once. Limits are checked by the command.
"""

from __future__ import annotations

from dataclasses import dataclass

METHODS = {  # of each paradigm, the default first
    "direct": ("bayes", "cnn", "clean-cnn", "stopping"),
    "compressive": ("mlp", "clean-mlp", "bayes"),
    "e2e": ("qat", "plain"),
    "fsi": ("deep", "pca"),
    "hadamard": ("differences", "counts"),
}


@dataclass(frozen=True, slots=True)
class BaselineOptions:
    """One way to measure and to decide; the meanings are those of `pans baseline`.

    `epochs`, `trials` and `floor` at None: the default of the method.
    """

    paradigm: str
    method: str
    features: int = 32
    patterns: str = "binary"
    detector: str = "counting"
    brightness: str = "source"
    floor: float | None = None
    dark: float = 0.0
    bits: int = 4
    epochs: int | None = None
    trials: int | None = None
    information: bool = False
    seed: int = 0
