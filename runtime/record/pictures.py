"""The pictures of a recorded run, recomputed from its clicks, and how they compare with the true ones.

Owns the pairing of decisions with the clicks behind them during a replay, and the file of pictures (.npz, never pickled); never reads a
recording (replaying.py). A decision that abstained has no picture.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.core.decision import Decision, DecisionFlag
from pans.runtime.decide.onnx import PictureDecider
from pans.runtime.decide.verdict import Decider, Verdict
from pans.runtime.errors import UsageError
from pans.runtime.image_quality import likeness
from pans.runtime.images import shipped_scene
from pans.runtime.npz_file import read_arrays
from pans.runtime.outputs import write_file

TRUTH_MAX_BYTES = 1 << 26  # as a scene file


class PictureLog:
    """Stands between a core and its back end and remembers the clicks of every decision that was made."""

    def __init__(self) -> None:
        self._decider: PictureDecider | None = None
        self._asked: list[NDArray[np.int64]] = []
        self._objects: list[int] = []
        self._shots = 1

    def over(self, decider: Decider) -> Decider:
        """Return the back end that the core is to ask; UsageError for one that returns no pictures."""
        if not isinstance(decider, PictureDecider):
            raise UsageError("the bundle decides among classes, it returns no pictures", remedy="leave --pictures out")
        self._decider = decider
        self.name, self.n_features, self.n_classes = decider.name, decider.n_features, decider.n_classes
        return self

    def decide(self, counts: NDArray[np.int64], shots: int) -> Verdict:
        """As `Decider`."""
        self._asked.append(counts.copy())
        self._shots = shots
        return self._back_end.decide(counts, shots)

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """As `Decider`."""
        return self._back_end.scores_batch(counts, shots)

    def decide_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.int64]:
        """As `Decider`."""
        return self._back_end.decide_batch(counts, shots)

    def note(self, decisions: Sequence[Decision]) -> None:
        """Take the decisions in their order: those that were asked for, in the order of asking."""
        for decision in decisions:
            if not decision.flags & DecisionFlag.ABSTAINED or decision.flags & DecisionFlag.NOT_FINITE:
                self._objects.append(decision.object)

    @property
    def _back_end(self) -> PictureDecider:
        assert self._decider is not None
        return self._decider

    def pictures(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the objects, int64 (n,), and their pictures cut to [0, 1], float32 (n, height, width)."""
        if len(self._objects) != len(self._asked):
            raise ValueError(f"{len(self._asked)} decisions were asked for, {len(self._objects)} came")
        shape = self._back_end.picture_shape
        if not self._asked:
            return np.zeros(0, np.int64), np.zeros((0, *shape), np.float32)
        return np.array(self._objects, np.int64), self._back_end.pictures(np.stack(self._asked), self._shots)

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write `object` and `pictures` to a .npz, whole or not at all; UsageError if it exists, unless `force`."""
        objects, pictures = self.pictures()
        stream = io.BytesIO()
        np.savez_compressed(stream, allow_pickle=False, object=objects, pictures=pictures)
        write_file(path, stream.getvalue(), force=force)

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
    try:
        images = read_arrays(path, ("images",), TRUTH_MAX_BYTES).get("images", np.zeros(0))
    except ValueError as error:
        raise UsageError(
            f"{path}: no scene with an array `images`: {error}",
            remedy="name a shipped scene or a .npz file with images",
        ) from error
    if images.dtype != np.uint8 or images.ndim != 3 or not images.size:
        raise UsageError(f"{path}: images are {images.dtype} {images.shape}, allowed: uint8 (n, height, width)")
    return np.asarray(images)
