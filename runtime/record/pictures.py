"""The pictures of a recorded run, recomputed from its clicks, and how they compare with the true ones.

A decision that abstained has no picture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.decide.onnx import PictureDecider
from pans.runtime.decide.verdict import Decider
from pans.runtime.errors import UsageError
from pans.runtime.images import likeness, scene_arrays, shipped_scene
from pans.runtime.npz_file import npz_bytes
from pans.runtime.outputs import write_file

from .replaying import ClickLog

TRUTH_MAX_BYTES = 1 << 26  # as a scene file


class PictureLog(ClickLog):
    """The log of a back end that returns pictures."""

    def over(self, decider: Decider) -> Decider:
        """Return the back end that the core is to ask; UsageError for one that returns no pictures."""
        if not isinstance(decider, PictureDecider):
            raise UsageError("the bundle decides among classes, it returns no pictures", remedy="leave --pictures out")
        self._pictures = decider
        return super().over(decider)

    def pictures(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the objects, int64 (n,), and their pictures cut to [0, 1], float32 (n, height, width)."""
        if len(self.decisions) != len(self.counts):
            raise ValueError(f"{len(self.counts)} decisions were asked for, {len(self.decisions)} came")
        if not self.counts:
            return np.zeros(0, np.int64), np.zeros((0, *self._pictures.picture_shape), np.float32)
        objects = np.array([decision.object for decision in self.decisions], np.int64)
        return objects, self._pictures.pictures(np.stack(self.counts), self.shots)

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write `object` and `pictures` to a .npz, whole or not at all; UsageError if it exists, unless `force`."""
        objects, pictures = self.pictures()
        write_file(path, npz_bytes(object=objects, pictures=pictures), force=force)

    def compare(self, truth: Path) -> dict[str, Any]:
        """Return SSIM and mean squared error against the scene in `truth` (.npz with `images`), whose objects pass in turn."""
        objects, pictures = self.pictures()
        images = _images(truth)
        alike = likeness(pictures, images[objects % len(images)])
        known = bool(len(objects))
        return {
            "ssim_mean": float(alike.ssim.mean()) if known else None,
            "mse_mean": float(alike.mse.mean()) if known else None,
            "pictures": len(objects),
        }


def _images(name: Path) -> NDArray[np.uint8]:
    path = name if name.exists() else shipped_scene(str(name)) or name
    return scene_arrays(path, TRUTH_MAX_BYTES)["images"]
