"""OUR generator of the task `tissue`: is tissue perfused? Laser speckle blurs where blood flows.

Owns the drawing of laser speckle on 64 x 64 pixels; never any image of the paper. `draw` returns uint8 images whose grey
level is the square root of the intensity averaged over one exposure.

The scene: laser light scattered by tissue makes a fully developed speckle (a circular Gaussian field behind a round
pupil, grain 3 to 5 px). Static scatterers keep it; flowing blood changes it during the exposure, and the image is the mean of the
intensities of what it passes through: share s of static light and the rest averaged over M independent patterns:
I = s I_static + (1 - s) mean of I_1 .. I_M.

- static (ischaemic): s from 0.85 to 1, M = 2: contrast (standard deviation over mean) 0.76 to 1.1;
- perfused: s from 0 to 0.25, M from 8 to 12: contrast 0.28 to 0.44.

Both: uneven light and absorption (smooth, sigma 14 px, +-20 %), brightness log-uniform over a factor of 2.5.

What makes it hard: the mean intensity follows the same distribution in both classes; a speckle is random in every pixel, so no
pixel and no linear sum of intensities differs in mean: the classes differ only in their fluctuation.

The physics: an exposure that averages over flow is no single coherent field. For the intensities (the square of these
amplitudes) an intensity mask in front of a bucket detector is exact, so the incoherent encoder is the physical default.
The paper (appendix "Tissue blood flow detection": synthetic, 64 x 64, 4000 training and 1000 test images per class) puts
its images through a coherent encoder; with these amplitudes as a field of flat phase that can be compared, but is a stylisation.
Its images are not public; grain, shares and numbers of patterns here are ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draw import Floats, Labels, draw_objects, per_image, smooth_noise, speckle, to_grey, uniform

SIDE_PX = 64
CLASSES = ("static", "perfused")
GRAINS_PX = (3.0, 4.0, 5.0)
PATTERNS_MAX = 12
MEAN_INTENSITY = (
    0.065,
    0.165,
)  # of full scale, drawn log-uniformly: a speckle's bright grains reach five times the mean


def draw(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` exposures, uint8 (n, 64, 64) root intensities and int64 (n,): 1 is perfused (OUR generator)."""
    return draw_objects(seed, "tissue", part, n, 2, _chunk)


def _chunk(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    n = len(labels)
    static_share = np.where(labels == 1, uniform(rng, 0.0, 0.25, n), uniform(rng, 0.85, 1.0, n))
    n_patterns = np.where(labels == 1, rng.integers(8, PATTERNS_MAX + 1, n), 2)
    intensity = np.empty((n, SIDE_PX, SIDE_PX), np.float32)
    grain = rng.integers(0, len(GRAINS_PX), n)
    for i, grain_px in enumerate(GRAINS_PX):
        mine = grain == i
        if mine.any():
            intensity[mine] = _exposure(rng, static_share[mine], n_patterns[mine], grain_px)
    uneven = np.clip(1 + 0.2 * smooth_noise(rng, n, SIDE_PX, SIDE_PX, 14.0), 0.3, None)
    mean = np.exp(uniform(rng, *np.log(MEAN_INTENSITY).tolist(), n))
    return to_grey(np.sqrt(intensity * uneven * per_image(mean)))


def _exposure(rng: np.random.Generator, static_share: Floats, n_patterns: Labels, grain_px: float) -> Floats:
    """Return exposure-averaged intensities of expected mean 1, (n, 64, 64)."""
    n = len(static_share)
    moving = np.zeros((n, SIDE_PX, SIDE_PX), np.float32)
    for i in range(int(n_patterns.max())):
        passing = n_patterns > i
        moving[passing] += np.abs(speckle(rng, int(passing.sum()), SIDE_PX, SIDE_PX, grain_px)) ** 2
    moving /= per_image(n_patterns.astype(np.float32))
    still = np.abs(speckle(rng, n, SIDE_PX, SIDE_PX, grain_px)) ** 2
    return per_image(static_share) * still + per_image(1 - static_share) * moving
