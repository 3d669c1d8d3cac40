"""A few pictures that a model of pictures gives back, kept as a small .npz: the first held-out object of every class, not the best ones."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.runtime.outputs import replace_file
from pans.trainer.model.detection import sample_clicks
from pans.trainer.model.heads import Heads
from pans.trainer.tasks.registry import Objects

SAMPLES = 3  # per object
SEED = 2  # not the clicks that the table is made of
PARTS = ("pictures", "shown", "given_back", "clicks")


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What was wanted and shown, uint8 (n, height, width), and what came back, uint8 (n, samples, height, width), of so many clicks."""

    pictures: NDArray[np.uint8]
    shown: NDArray[np.uint8]
    given_back: NDArray[np.uint8]
    clicks: NDArray[np.int64]  # (n, samples)


def first_of_each_class(objects: Objects) -> Objects:
    """Return the first object of every class that there is, in the order of the classes."""
    which = np.unique(objects.labels, return_index=True)[1]
    behind = None if objects.behind is None else objects.behind[which]
    return Objects(objects.images[which], objects.labels[which], behind)


def take_samples(head: Heads, p: Tensor, objects: Objects) -> Samples:
    """Return samples of `objects` whose click probabilities are `p` (n, d_f)."""
    random = torch.Generator().manual_seed(SEED)
    clicks = torch.stack([sample_clicks(p, random) for _ in range(SAMPLES)], dim=1)
    with torch.no_grad():
        given_back = torch.stack([head(drawn.float()) for drawn in clicks.unbind(1)], dim=1).clamp(0, 1)
    pixels = (255 * given_back).round().to(torch.uint8).unflatten(2, objects.pictures.shape[1:])
    return Samples(objects.pictures, objects.images, pixels.numpy(), clicks.sum(dim=2).long().numpy())


def keep_samples(path: Path, samples: Samples) -> None:
    """Write `samples` to `path` (.npz), whole or not at all."""
    archive = io.BytesIO()
    np.savez_compressed(archive, **{part: getattr(samples, part) for part in PARTS})
    replace_file(path, archive.getvalue())


def read_samples(path: Path) -> Samples:
    """Return what `keep_samples` wrote."""
    with np.load(path, allow_pickle=False) as archive:
        return Samples(*(archive[part] for part in PARTS))
