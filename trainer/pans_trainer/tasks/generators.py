"""The tasks that are drawn, not read: their generators by name, what their grey levels mean, and what encoder suits them.

Every generator is OURS: the paper's images for these tasks are not public in a form that can be reached. docs/reference/tasks.md shows and
measures them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.bundle.sensor import Light

from . import barcode, cells, fields
from .draw import Labels

Draw = Callable[[int, str, int], tuple[NDArray[np.uint8], Labels]]


@dataclass(frozen=True, slots=True)
class Recipe:
    """One drawn task: `light` is what grey / 255 means (`transmission` of an object that we light, or `field` amplitude)."""

    summary: str
    classes: tuple[str, ...]
    image_shape: tuple[int, int]
    light: Light
    encoder: str  # that the physics asks for: active, coherent or incoherent
    n_train: int  # objects drawn by default; the numbers of the paper stand in the modules of the tasks
    n_test: int
    draw: Draw

    @property
    def source(self) -> str:
        """Where the images come from, for reports."""
        return f"drawn by OUR generator {self.draw.__module__}, not the paper's images"


_Kind = tuple[tuple[int, int], Light, str]  # height and width, what grey means, the encoder
CELL: _Kind = ((cells.SIDE_PX, cells.SIDE_PX), "transmission", "active")
BARS: _Kind = ((1, barcode.N_BARS), "transmission", "active")
COHERENT: _Kind = ((64, 64), "field", "coherent")
INCOHERENT: _Kind = ((64, 64), "field", "incoherent")  # the paper's encoder is coherent here too

GENERATORS: Mapping[str, Recipe] = {
    "cells": Recipe(
        "which organelle is stained in a flowing cell, or is there none", cells.CLASSES, *CELL, 20_000, 4000, cells.draw
    ),
    "cells-3": Recipe(
        "which organelle is stained in a flowing cell", cells.CLASSES[:3], *CELL, 15_000, 3000, cells.draw_without_null
    ),
    "barcode": Recipe("do ten bars contain 1010", barcode.CLASSES, *BARS, 4000, 1000, barcode.draw),
    "transient": Recipe(
        "is there a small object in a coherently lit scene",
        fields.EVENTS,
        *COHERENT,
        12_000,
        2000,
        fields.draw_transient,
    ),
    "tissue": Recipe(
        "does laser speckle show blood flow", fields.PERFUSION, *INCOHERENT, 8000, 2000, fields.draw_tissue
    ),
    "nebula": Recipe("planetary or emission nebula", fields.NEBULAE, *INCOHERENT, 12_000, 2000, fields.draw_nebula),
    "fiber": Recipe(
        "is the end face of a fibre contaminated", fields.END_FACES, *COHERENT, 12_000, 2000, fields.draw_fiber
    ),
}
