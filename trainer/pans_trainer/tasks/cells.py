"""OUR generator of the task `cells`: one stained organelle per cell, or none, on 100 x 100 pixels, for active illumination.

- membrane: a thin bright outline, uneven along the circumference, with up to 5 vesicles inside;
- nucleolus: 1 to 4 compact spots in a faint nucleus;
- mitochondria: 10 to 22 short threads of beads in the cytoplasm around a dark nucleus;
- null: no cell in focus: haze of cells out of focus and up to 4 specks of debris.

The mean of an image is drawn without regard to the class: total intensity tells nothing, for the null class neither. The paper (appendix
"Cell-organelle classification") has its images from an imaging flow cytometer (Schraivogel et al., 2022); its null fields are "empty", so
probably darker than its cells, which ours are not. docs/reference/tasks.md shows ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draw import (
    Floats,
    Labels,
    bell,
    blur,
    draw_objects,
    normal,
    per_image,
    places,
    smooth_noise,
    soft_inside,
    some_of,
    spots,
    to_grey,
    uniform,
    waviness,
    with_mean,
)

SIDE_PX = 100
CLASSES = ("membrane", "nucleolus", "mitochondria", "null")
MEAN_GREY = (6 / 255, 12 / 255)  # drawn log-uniformly, the same for every class
RADIUS_PX = (25, 30)
OFFSET_PX = 3
STAIN_SHARE = (0.75, 1.0)
PEAK_TO_MEAN = 20.0
NOISE_GREY = 1.5 / 255  # of the camera, before negative values are cut
N_THREADS, N_BEADS = 22, 9


def draw(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` cells of four classes, uint8 (n, 100, 100) and int64 (n,) (OUR generator)."""
    return draw_objects(seed, "cells", part, n, 4, _chunk)


def draw_without_null(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` cells of three classes, as in the paper's release (OUR generator)."""
    return draw_objects(seed, "cells-3", part, n, 3, _chunk)


def _chunk(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    images = np.empty((len(labels), SIDE_PX, SIDE_PX), np.float32)
    for label, scene in enumerate((_membrane, _nucleolus, _mitochondria, _null)):
        mine = labels == label
        if mine.any():
            images[mine] = scene(rng, int(mine.sum()))
    low, high = np.log(MEAN_GREY)
    mean = np.exp(uniform(rng, low, high, len(labels)))
    sharp = with_mean(blur(images, 0.8), np.ones_like(mean))
    images = with_mean(sharp / np.sqrt(1 + (sharp / PEAK_TO_MEAN) ** 2), mean)  # bright stain saturates, not the 8 bits
    return to_grey(with_mean(images + normal(rng, *images.shape) * NOISE_GREY, mean))


class _Cell:
    """The outlines of `n` cells: polar coordinates, the normalised radius `rho` (1 at the membrane), and the nucleus."""

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        self.radius_px = uniform(rng, *RADIUS_PX, n)
        self.centre_y, self.centre_x = uniform(rng, -OFFSET_PX, OFFSET_PX, n), uniform(rng, -OFFSET_PX, OFFSET_PX, n)
        v, u = places(SIDE_PX, self.centre_y, self.centre_x, uniform(rng, 0, np.pi, n))
        v = v / per_image(uniform(rng, 0.72, 1, n))
        r_px = np.sqrt(v * v + u * u) + 1e-3
        self.sin, self.cos = v / r_px, u / r_px
        outline = 1 + waviness(rng, self.sin, self.cos, range(2, 6), 0.07)
        self.rho = r_px / (per_image(self.radius_px) * outline)
        inside = soft_inside((self.rho - 1) * per_image(self.radius_px), 2.0)
        self.body = inside * (1 + 0.35 * smooth_noise(rng, n, SIDE_PX, 4.0))
        self.nucleus_px = self.radius_px * uniform(rng, 0.38, 0.58, n)
        off, turn = self.radius_px * uniform(rng, 0, 0.3, n), uniform(rng, 0, 2 * np.pi, n)
        self.nucleus_y, self.nucleus_x = self.centre_y + off * np.sin(turn), self.centre_x + off * np.cos(turn)
        v, u = places(SIDE_PX, self.nucleus_y, self.nucleus_x, uniform(rng, 0, np.pi, n))
        v = v / per_image(uniform(rng, 0.75, 1, n))
        self.nucleus = soft_inside(np.sqrt(v * v + u * u) - per_image(self.nucleus_px), 1.5)


def _stained(rng: np.random.Generator, stain: Floats, cell: _Cell) -> Floats:
    """Mix the stain with the glow of the whole cell, each of mean 1, and faint light from everywhere."""
    n = len(stain)
    share = uniform(rng, *STAIN_SHARE, n)
    ones = np.ones(n, np.float32)
    mix = with_mean(stain, share) + with_mean(cell.body, ones - share)
    return mix + per_image(uniform(rng, 0.0, 0.25, n))


def _membrane(rng: np.random.Generator, n: int) -> Floats:
    cell = _Cell(rng, n)
    away_px = (cell.rho - 1) * per_image(cell.radius_px)
    uneven = np.maximum(1 + waviness(rng, cell.sin, cell.cos, range(1, 7), 0.7), 0.1)
    outline = bell(away_px, per_image(uniform(rng, 1.2, 2.2, n))) * uneven
    r, turn = cell.radius_px[:, None] * uniform(rng, 0, 0.85, n, 5), uniform(rng, 0, 2 * np.pi, n, 5)
    vesicles = spots(
        *(SIDE_PX, SIDE_PX),
        cell.centre_y[:, None] + r * np.sin(turn),
        cell.centre_x[:, None] + r * np.cos(turn),
        uniform(rng, 1.2, 2.4, n, 5),
        uniform(rng, 0.5, 2.0, n, 5) * some_of(rng, n, 0, 5),
    )
    return _stained(rng, outline + vesicles, cell)


def _nucleolus(rng: np.random.Generator, n: int) -> Floats:
    cell = _Cell(rng, n)
    r, turn = cell.nucleus_px[:, None] * uniform(rng, 0, 0.75, n, 4), uniform(rng, 0, 2 * np.pi, n, 4)
    nucleoli = spots(
        *(SIDE_PX, SIDE_PX),
        cell.nucleus_y[:, None] + r * np.sin(turn),
        cell.nucleus_x[:, None] + r * np.cos(turn),
        uniform(rng, 1.6, 3.4, n, 4),
        uniform(rng, 0.5, 1.0, n, 4) * some_of(rng, n, 1, 4),
    )
    return _stained(rng, nucleoli + per_image(uniform(rng, 0.08, 0.3, n)) * cell.nucleus, cell)


def _mitochondria(rng: np.random.Generator, n: int) -> Floats:
    cell = _Cell(rng, n)
    shape = (n, N_THREADS, N_BEADS)
    start, drift = uniform(rng, 0.45, 0.78, n, N_THREADS, 1), normal(rng, n, N_THREADS, 1) * 0.02
    turn = uniform(rng, 0, 2 * np.pi, n, N_THREADS, 1)
    step_px = uniform(rng, 1.0, 2.0, n, N_THREADS, 1)
    bead = np.arange(N_BEADS, dtype=np.float32)
    wander = np.cumsum(normal(rng, *shape), axis=2) * 0.02
    r = cell.radius_px[:, None, None] * np.clip(start + drift * bead + wander, 0.4, 0.85)
    around = turn + bead * step_px / cell.radius_px[:, None, None]
    there = some_of(rng, n, 10, N_THREADS)[:, :, None] * (bead < rng.integers(3, N_BEADS + 1, (n, N_THREADS, 1)))
    threads = spots(
        *(SIDE_PX, SIDE_PX),
        (cell.centre_y[:, None, None] + r * np.sin(around)).reshape(n, -1),
        (cell.centre_x[:, None, None] + r * np.cos(around)).reshape(n, -1),
        uniform(rng, 1.0, 1.6, n, N_THREADS * N_BEADS),
        (uniform(rng, 0.4, 1.0, n, N_THREADS, 1) * there).reshape(n, -1).astype(np.float32),
    )
    return _stained(rng, threads * (1 - 0.85 * cell.nucleus), cell)


def _null(rng: np.random.Generator, n: int) -> Floats:
    haze = 1 + per_image(uniform(rng, 0.2, 0.9, n)) * smooth_noise(rng, n, SIDE_PX, 14.0)
    debris = spots(
        *(SIDE_PX, SIDE_PX),
        uniform(rng, -48, 48, n, 4),
        uniform(rng, -48, 48, n, 4),
        uniform(rng, 1.0, 2.5, n, 4),
        uniform(rng, 2.0, 12.0, n, 4) * some_of(rng, n, 0, 4),
    )
    return np.maximum(haze, 0) + debris
