"""Pictures given back, kept beside a cell of the table of pictures and drawn beside what was shown.

Owns a few samples of a finished model as a small .npz, and their figure; never trains and never judges (the table does, on all held-out
objects). The objects are the first held-out one of every class, so that nothing is picked by how well it came out; every sample is one
shot with clicks of its own. Drawn after the paper's figure of the fibre: digits, speckle, what came back.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.runtime.container import replace_file
from pans.trainer.figures import new_figure, save_figure
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


def draw_samples(path: Path, name: str, cells: list[tuple[str, Samples]]) -> None:
    """Draw the objects and their speckle above, and for every model (title, samples) the pictures that came back, to `path` (PNG)."""
    first = cells[0][1]
    rows = [("shown to the fibre", first.pictures), ("speckle behind it", first.shown)]
    for title, samples in cells:
        rows += [(title if i == 0 else "", samples.given_back[:, i]) for i in range(SAMPLES)]
    clicks = [None, None, *(samples.clicks[:, i] for _, samples in cells for i in range(SAMPLES))]
    n = len(first.pictures)
    figure, axes = new_figure(width=0.95 * n + 1.9, height=1.02 * len(rows) + 0.4, panels=n, rows=len(rows))
    for line, (title, pictures), counts in zip(axes, rows, clicks):
        for i, (axis, picture) in enumerate(zip(line, pictures)):
            brightest = 255 if counts is not None or pictures is first.pictures else max(1, int(picture.max()))
            axis.imshow(picture, cmap="gray", vmin=0, vmax=brightest)
            axis.set(xticks=[], yticks=[])
            if counts is not None:
                axis.set_title(f"clicks: {int(counts[i])}", fontsize=7, pad=2)
        line[0].set_ylabel(title, rotation=0, ha="right", va="center", fontsize=8)
    figure.suptitle(
        f"{name}: the first held-out digit of every class, {SAMPLES} single shots each (SIMULATED)", fontsize=9
    )
    save_figure(figure, path)
