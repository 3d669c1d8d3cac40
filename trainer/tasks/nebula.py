"""OUR generator of the task `nebula`: planetary or emission nebula, in the light of one spectral line.

Owns the drawing of compact nebulae on 64 x 64 pixels; never any image of the paper. `draw` returns uint8 images whose grey
level is a field amplitude (the square root of the intensity that a narrow-band camera would see), for passive encoders. The
flat phase across the field is the paper's assumption (a compact, quasi-monochromatic source): real nebulae are incoherent, and
for them the incoherent encoder on the square of these amplitudes is the physical one.

- planetary: one or two elliptical shells (radius 9 to 14 px, thickness 0.15 to 0.3 of it, axis ratio 0.75 to 1), brighter
  towards one side or both poles, a faint filling, often a central star;
- emission: turbulent gas (fractal noise, amplitude falling as frequency**-1.7, exponentiated) under an irregular envelope of
  about the same size, with dark lanes.

Both: place within +-2 px in y and x, any orientation, 2 to 8 field stars of random brightness (3 to 12 % of the light), sky (2 to
10 %), seeing (blur of sigma 0.9 px), noise (0.008 of full scale in amplitude).

What makes it hard: the mean intensity is drawn log-uniformly over a factor of 2.25 without regard to the class; extent
and central brightness overlap (some shells are filled, some clouds are hollow); stars give both classes bright points.

The paper (appendix "Compact nebula classification"): synthetic, 64 x 64, 4000 training and 1000 test images per class,
mean intensities overlap. Its images are not public; ours share the description alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draw import (
    Floats,
    Labels,
    bell,
    blur,
    cloud_noise,
    draw_objects,
    normal,
    per_image,
    places,
    some_of,
    spots,
    to_grey,
    uniform,
    waviness,
    with_mean,
)

SIDE_PX = 64
CLASSES = ("planetary", "emission")
MEAN_INTENSITY = (0.02, 0.045)  # of full scale, drawn log-uniformly
PEAK_TO_MEAN = 20.0
PLACE_PX = 2.0
RADIUS_PX = (9.0, 14.0)
STARS = (2, 8)
STAR_SHARE = (0.03, 0.12)
NOISE = 0.008


def draw(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` nebulae, uint8 (n, 64, 64) amplitudes and int64 (n,): 0 planetary, 1 emission (OUR generator)."""
    return draw_objects(seed, "nebula", part, n, 2, _chunk)


def _chunk(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    n = len(labels)
    gas = np.empty((n, SIDE_PX, SIDE_PX), np.float32)
    for label, scene in enumerate((_planetary, _emission)):
        mine = labels == label
        if mine.any():
            gas[mine] = scene(rng, int(mine.sum()))
    share = uniform(rng, *STAR_SHARE, n)
    sky = uniform(rng, 0.02, 0.1, n)
    scene_light = with_mean(gas, 1 - share - sky) + with_mean(_stars(rng, n), share) + per_image(sky)
    mean = np.exp(uniform(rng, *np.log(MEAN_INTENSITY).tolist(), n))
    seen = with_mean(blur(scene_light, 0.9), np.ones_like(mean))
    seen = with_mean(seen / np.sqrt(1 + (seen / PEAK_TO_MEAN) ** 2), mean)
    return to_grey(np.sqrt(seen) + NOISE * normal(rng, *seen.shape))


class _Frame:
    """Coordinates around a nebula: normalised radius `rho` (1 at its size) and the sine and cosine of the angle."""

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        v, u = places(
            *(SIDE_PX, SIDE_PX),
            uniform(rng, -PLACE_PX, PLACE_PX, n),
            uniform(rng, -PLACE_PX, PLACE_PX, n),
            uniform(rng, 0, np.pi, n),
        )
        v = v / per_image(uniform(rng, 0.75, 1, n))
        r_px = np.sqrt(u * u + v * v) + 1e-3
        self.sin, self.cos = v / r_px, u / r_px
        self.rho = r_px / per_image(uniform(rng, *RADIUS_PX, n))


def _planetary(rng: np.random.Generator, n: int) -> Floats:
    frame = _Frame(rng, n)
    outline = 1 + waviness(rng, frame.sin, frame.cos, range(2, 5), 0.05)
    rho = frame.rho / outline
    uneven = np.maximum(1 + waviness(rng, frame.sin, frame.cos, range(1, 5), 0.45), 0.1)
    shell = bell(rho - 1, per_image(uniform(rng, 0.15, 0.3, n))) * uneven
    second = bell(rho - per_image(uniform(rng, 0.45, 0.7, n)), 0.12) * per_image(uniform(rng, 0.2, 0.8, n))
    filling = bell(rho, 0.6) * per_image(uniform(rng, 0.1, 0.6, n))
    star = bell(rho * 4, 0.35) * per_image(uniform(rng, -1.0, 2.0, n).clip(0))
    twice = per_image((rng.random(n) < 0.35).astype(np.float32))
    return shell + twice * second + filling + star


def _emission(rng: np.random.Generator, n: int) -> Floats:
    frame = _Frame(rng, n)
    outline = 1 + waviness(rng, frame.sin, frame.cos, range(1, 6), 0.25)
    envelope = np.exp(-0.5 * (frame.rho / np.maximum(outline, 0.3)) ** 2 * 2.4)
    turbulence = cloud_noise(rng, n, SIDE_PX, SIDE_PX, 1.7)
    lanes = 1 / (1 + np.exp(4 * (cloud_noise(rng, n, SIDE_PX, SIDE_PX, 1.7) - 0.7)))
    gas: Floats = envelope * np.exp(0.75 * turbulence) * lanes
    return gas


def _stars(rng: np.random.Generator, n: int) -> Floats:
    most = STARS[1]
    brightness = np.exp(1.0 * normal(rng, n, most)) * some_of(rng, n, *STARS)
    half = SIDE_PX / 2
    return spots(
        *(SIDE_PX, SIDE_PX),
        uniform(rng, -half, half, n, most),
        uniform(rng, -half, half, n, most),
        np.full((n, most), 0.7, np.float32),
        brightness.astype(np.float32),
    )
