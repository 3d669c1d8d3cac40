"""The tasks that are drawn, not read: their generators by name, what their grey levels mean, and what encoder suits them.

Owns the list and the provenance; never draws itself (see the task_*.py files) and never reads a file. `generate` returns a
`Drawn`: images uint8 (n, height, width), labels int64 (n,), for training and held out. Every generator here is OURS: the paper's
images for these tasks are not public in a form that can be reached. docs/reference/tasks.md shows and measures them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.incident import Light
from pans.runtime.errors import UsageError

from . import barcode as task_barcode
from . import cells as task_cells
from . import fiber as task_fiber
from . import nebula as task_nebula
from . import tissue as task_tissue
from . import transient as task_transient
from .draw import Labels

Draw = Callable[[int, str, int], tuple[NDArray[np.uint8], Labels]]


@dataclass(frozen=True, slots=True)
class Recipe:
    """One drawn task: `light` is what grey / 255 means (`transmission` of an object that we light, or `field` amplitude)."""

    name: str
    summary: str
    classes: tuple[str, ...]
    image_shape: tuple[int, int]
    light: Light
    encoder: str  # that the physics asks for: active, coherent or incoherent
    paper_encoder: str
    n_train: int
    n_test: int
    paper_objects: str
    draw: Draw

    @property
    def n_objects(self) -> int:
        """Objects drawn by default, for training and held out."""
        return self.n_train + self.n_test

    @property
    def source(self) -> str:
        """Where the images come from, for reports."""
        return f"drawn by OUR generator {self.draw.__module__}, not the paper's images"


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """The objects of one recipe and seed."""

    recipe: Recipe
    seed: int
    train_images: NDArray[np.uint8]
    train_labels: Labels
    test_images: NDArray[np.uint8]
    test_labels: Labels

    @property
    def sha256(self) -> str:
        """The SHA-256 of all images and labels (little-endian), hex."""
        digest = hashlib.sha256()
        for images, labels in ((self.train_images, self.train_labels), (self.test_images, self.test_labels)):
            digest.update(np.ascontiguousarray(images).data)
            digest.update(labels.astype("<i8").data)
        return digest.hexdigest()

    def provenance(self) -> dict[str, Any]:
        """Return what a bundle or a report says about these images, JSON-able."""
        return {
            "task": self.recipe.name,
            "source": self.recipe.source,
            "seed": self.seed,
            "n_train": len(self.train_labels),
            "n_test": len(self.test_labels),
            "light": self.recipe.light,
            "sha256": self.sha256,
        }


GENERATORS: Mapping[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        Recipe(
            name="cells",
            summary="which organelle is stained in a flowing cell, or is there none",
            classes=task_cells.CLASSES,
            image_shape=(task_cells.SIDE_PX, task_cells.SIDE_PX),
            light="transmission",
            encoder="active",
            paper_encoder="active",
            n_train=20_000,
            n_test=4000,
            paper_objects="10 000 + 1000 per class",
            draw=task_cells.draw,
        ),
        Recipe(
            name="cells-3",
            summary="which organelle is stained in a flowing cell",
            classes=task_cells.CLASSES[:3],
            image_shape=(task_cells.SIDE_PX, task_cells.SIDE_PX),
            light="transmission",
            encoder="active",
            paper_encoder="active",
            n_train=15_000,
            n_test=3000,
            paper_objects="10 000 + 1000 per class (release)",
            draw=task_cells.draw_without_null,
        ),
        Recipe(
            name="barcode",
            summary="do ten bars contain 1010",
            classes=task_barcode.CLASSES,
            image_shape=(1, task_barcode.N_BARS),
            light="transmission",
            encoder="active",
            paper_encoder="active",
            n_train=4000,
            n_test=1000,
            paper_objects="4000 + 1000",
            draw=task_barcode.draw,
        ),
        Recipe(
            name="transient",
            summary="is there a small object in a coherently lit scene",
            classes=task_transient.CLASSES,
            image_shape=(task_transient.SIDE_PX, task_transient.SIDE_PX),
            light="field",
            encoder="coherent",
            paper_encoder="coherent",
            n_train=12_000,
            n_test=2000,
            paper_objects="4000 + 1000",
            draw=task_transient.draw,
        ),
        Recipe(
            name="tissue",
            summary="does laser speckle show blood flow",
            classes=task_tissue.CLASSES,
            image_shape=(task_tissue.SIDE_PX, task_tissue.SIDE_PX),
            light="field",
            encoder="incoherent",
            paper_encoder="coherent",
            n_train=8000,
            n_test=2000,
            paper_objects="4000 + 1000 per class",
            draw=task_tissue.draw,
        ),
        Recipe(
            name="nebula",
            summary="planetary or emission nebula",
            classes=task_nebula.CLASSES,
            image_shape=(task_nebula.SIDE_PX, task_nebula.SIDE_PX),
            light="field",
            encoder="incoherent",
            paper_encoder="coherent",
            n_train=12_000,
            n_test=2000,
            paper_objects="4000 + 1000 per class",
            draw=task_nebula.draw,
        ),
        Recipe(
            name="fiber",
            summary="is the end face of a fibre contaminated",
            classes=task_fiber.CLASSES,
            image_shape=(task_fiber.SIDE_PX, task_fiber.SIDE_PX),
            light="field",
            encoder="coherent",
            paper_encoder="coherent",
            n_train=12_000,
            n_test=2000,
            paper_objects="4000 + 1000",
            draw=task_fiber.draw,
        ),
    )
}


def generate(name: str, seed: int = 0, n_train: int | None = None, n_test: int | None = None) -> Drawn:
    """Return the objects of the drawn task `name`; UsageError for an unknown name, a negative seed or no objects.

    The same seed gives the same objects, object by object, whatever the numbers asked for (default: the recipe's).
    """
    if name not in GENERATORS:
        raise UsageError(f"no generator for the task {name!r}", remedy=f"there are {', '.join(GENERATORS)}")
    if seed < 0:
        raise UsageError(f"seed {seed} of the task {name}", remedy="0 or more")
    recipe = GENERATORS[name]
    train = recipe.draw(seed, "train", recipe.n_train if n_train is None else n_train)
    test = recipe.draw(seed, "test", recipe.n_test if n_test is None else n_test)
    return Drawn(recipe, seed, *train, *test)
