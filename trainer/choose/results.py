"""What a sensor for a user's own images achieves on images that it has not seen, beside a camera: `SensorResults`. All SIMULATED."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class CameraResults:
    """An ideal camera, decided on by the exact posterior, on the same images; gains are the sensor's figure minus the camera's.

    Shares from 0 to 1; `_se` are standard errors over the images, those of gains paired: image by image.
    """

    accuracy: float
    accuracy_se: float
    accuracy_gain: float
    accuracy_gain_se: float
    balanced_accuracy: float
    balanced_accuracy_se: float
    balanced_accuracy_gain: float
    balanced_accuracy_gain_se: float
    clicks: float
    photons: float
    illumination: float


@dataclass(frozen=True, slots=True, eq=False)
class SensorResults:
    """What a trained sensor decides on held-out images; shares from 0 to 1, `_se` standard errors over the images.

    `confusion` float64 (classes, classes) counts held-out images by true class (row) and decided class, in expectation.
    `clicks`, `photons` and `illumination` (photoelectrons that a clear pixel would give, summed over pixels and patterns) are
    means per decision.
    """

    classes: tuple[str, ...]
    accuracy: float
    accuracy_se: float
    balanced_accuracy: float  # mean of the recalls
    balanced_accuracy_se: float
    majority_class: str
    majority: float  # the accuracy of always naming it
    recall: dict[str, float]
    recall_interval: dict[str, tuple[float, float]]  # 95 %, Wilson's
    images: dict[str, int]  # held out, by class
    clicks: float
    photons: float
    illumination: float
    camera_at_equal_photons: CameraResults | None  # None where a decision takes no light
    camera_at_equal_illumination: CameraResults | None
    confusion: NDArray[np.float64]
    folds: int  # sensors, each judged on images that it has not seen; 1: one, on the held-out images
    seconds: float  # of the training and the comparison
    bundle: Path | None
    sha256: str = ""
    simulated: bool = True

    def as_json(self) -> dict[str, Any]:
        """Return the results as plain values of JSON, keyed by the names of the fields."""
        plain = asdict(self)
        plain["bundle"] = None if self.bundle is None else str(self.bundle)
        return plain | {"classes": list(self.classes), "confusion": self.confusion.tolist()}
