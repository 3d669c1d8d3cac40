"""What the independent firmware measures: uploaded patterns times the objects of a scene, and clicks.

From docs/reference: protocol.md ("Patterns and light"), profiles.md (`peak_photoelectrons_hz`, the click law without read noise) and
simulator.md (scene files).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass
class Light:
    """Objects in a row before the detector, and the light of one pattern set on them."""

    images: NDArray[np.uint8]  # (objects, height, width)
    labels: NDArray[np.int64]  # (objects,), -1: unknown
    peak_photoelectrons_hz: float
    levels: int
    seed: int = 0
    expected: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))  # (objects, patterns)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    @classmethod
    def of_scene(cls, path: Path, peak_photoelectrons_hz: float, levels: int, seed: int) -> Light:
        """Read a scene file."""
        with np.load(path, allow_pickle=False) as scene:
            images = scene["images"]
            labels = scene["labels"].astype(np.int64) if "labels" in scene else np.full(len(images), -1)
        return cls(images, labels, peak_photoelectrons_hz, levels, seed)

    def show(self, patterns: NDArray[np.uint16], exposure_s: float) -> None:
        """Take a pattern set, (patterns, pixels), row after row from the top, for exposures of this length."""
        transmission = self.images.reshape(len(self.images), -1) / 255.0
        top = self.peak_photoelectrons_hz * exposure_s / (self.levels - 1)
        self.expected = transmission @ (patterns.astype(np.float64) * top).T

    def clicks(self, number: int, patterns: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Draw one click for each of `patterns` (-1: dark) shown to the object that comes as number `number`."""
        row = self.expected[number % len(self.images)]
        mean = np.where(patterns >= 0, row[np.maximum(patterns, 0)], 0.0)
        return (self._rng.random(len(patterns)) < 1 - np.exp(-mean)).astype(np.uint8)

    def truth(self, number: int) -> tuple[int, float]:
        """Class and expected photoelectrons of one shot on an object."""
        row = number % len(self.images)
        return int(self.labels[row]), float(self.expected[row].sum())
