"""OUR generator of the task `fiber`: is the end face of an optical fibre clean or contaminated?

Owns the drawing of mode fields on 64 x 64 pixels; never any image of the paper. `draw` returns uint8 images whose grey level
is a field amplitude, for passive encoders (a small part of the signal light is tapped).

The scene: light of the fundamental mode leaves the fibre: a Gaussian amplitude of radius 13 to 15 px (1/e), misaligned by up to
1.5 px in y and x, a little elliptical (0.94 to 1), with surface roughness (smooth noise of sigma 1.5 px, 0.01 of the amplitude)
and detector noise (0.003 of full scale). On a contaminated end face 2 to 4 defects lie where the light is:

- dirt: a round patch (sigma 2 to 4 px) that takes 0.5 to 1 of the amplitude;
- pit: a dark ring (radius 2 to 4 px, width 1 px, depth 0.5 to 0.9) around a spot that is brighter by a third of its depth;
- scratch: a straight line (sigma 0.8 to 1.4 px, 16 to 40 px long) that takes 0.4 to 0.8 of the amplitude.

What makes it hard: the power at the tap varies by a factor of 2 without regard to the class. (Defects also shadow 10 to 35 % of
the light; that is taken out, as behind a levelled source, or brightness alone would tell.) Alignment and size change the
field everywhere, a defect may lie anywhere on it and be darker or brighter.

The paper (appendix "Fiber end-face inspection") calls it a toy model: clean end faces are uniform, contaminated ones have
localised anomalies; 64 x 64, 4000 training and 1000 test images. Its images are not public; shapes and sizes are ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draw import (
    Floats,
    Labels,
    bell,
    draw_objects,
    normal,
    per_image,
    places,
    smooth_noise,
    soft_inside,
    to_grey,
    uniform,
    with_mean,
)

SIDE_PX = 64
CLASSES = ("clean", "contaminated")
MODE_PX = (13.0, 15.0)
MISALIGNED_PX = 1.5
MEAN_INTENSITY = (0.025, 0.05)  # of full scale; the centre of a mode stays below full scale
ROUGHNESS = 0.01
NOISE = 0.003
DEFECTS_MAX = 4


def draw(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` end faces, uint8 (n, 64, 64) amplitudes and int64 (n,): 1 is contaminated (OUR generator)."""
    return draw_objects(seed, "fiber", part, n, 2, _chunk)


def _chunk(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    n = len(labels)
    centre_y, centre_x = uniform(rng, -MISALIGNED_PX, MISALIGNED_PX, n), uniform(rng, -MISALIGNED_PX, MISALIGNED_PX, n)
    v, u = places(SIDE_PX, SIDE_PX, centre_y, centre_x, uniform(rng, 0, np.pi, n))
    v = v / per_image(uniform(rng, 0.94, 1, n))
    mode_px = uniform(rng, *MODE_PX, n)
    mode = np.exp(-(u**2 + v**2) / per_image(mode_px) ** 2)
    passed = 1 + ROUGHNESS * smooth_noise(rng, n, SIDE_PX, SIDE_PX, 1.5)
    many = rng.integers(2, DEFECTS_MAX + 1, n)
    for i in range(DEFECTS_MAX):
        there = (labels == 1) & (many > i)
        r_px, turn = mode_px * np.sqrt(uniform(rng, 0, 0.6, n)), uniform(rng, 0, 2 * np.pi, n)
        depth = _defects(rng, centre_y + r_px * np.sin(turn), centre_x + r_px * np.cos(turn))
        passed *= 1 - depth * per_image(there.astype(np.float32))
    intensity = with_mean((mode * passed) ** 2, uniform(rng, *MEAN_INTENSITY, n))
    return to_grey(np.sqrt(intensity) + NOISE * normal(rng, n, SIDE_PX, SIDE_PX))


def _defects(rng: np.random.Generator, y: Floats, x: Floats) -> Floats:
    """Return how much of the amplitude one defect takes, (n, 64, 64): dirt, a pit or a scratch at (y, x) per image."""
    n = len(y)
    kind = per_image(rng.integers(0, 3, n).astype(np.float32))
    v, u = places(SIDE_PX, SIDE_PX, y, x, uniform(rng, 0, np.pi, n))
    r = np.sqrt(u * u + v * v)
    dirt = per_image(uniform(rng, 0.5, 1.0, n)) * bell(r, per_image(uniform(rng, 2.0, 4.0, n)))
    ring_px = per_image(uniform(rng, 2.0, 4.0, n))
    pit = per_image(uniform(rng, 0.5, 0.9, n)) * (bell(r - ring_px, 1.0) - bell(r, ring_px / 2) / 3)
    along = soft_inside(np.abs(u) - per_image(uniform(rng, 8, 20, n)), 1.0)
    scratch = per_image(uniform(rng, 0.4, 0.8, n)) * bell(v, per_image(uniform(rng, 0.8, 1.4, n))) * along
    return np.where(kind == 0, dirt, np.where(kind == 1, pit, scratch))
