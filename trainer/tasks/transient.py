"""OUR generator of the task `transient`: is there a small, fleeting object in a coherently lit scene, or only background?

Owns the drawing of monitored scenes on 64 x 64 pixels; never any image of the paper. `draw` returns uint8 images whose grey
level is a field amplitude (the square root of intensity), for passive encoders.

The scene: uniform coherent light falls on a scene; its background is a bright field that varies slowly in space (sigma of
the unevenness 16 px, +-25 % in amplitude) and in total (power of one frame to the next: +-30 %), with fine noise on every pixel
(0.012 of full scale). An event is one compact object (sigma 2 to 3 px, elongated up to 1.6 times, turned at random) anywhere
inside the inner 40 x 40 pixels, which adds or removes a peak amplitude of 0.18 to 0.32 of full scale, in phase or in antiphase.

What makes it hard: the event changes the power of a frame by 1 % (median; at most about 5 %), up or down, while the background
fluctuates by 40 % (standard deviation); it may be anywhere; and a photon from the background looks like one from the event. A
coherent encoder can dim the slow background by interference; counting light cannot.

The paper (appendix "Transient event detection"): synthetic, 64 x 64, 4000 training and 1000 test images, mean intensities
annotated to show that they overlap. Its images are not public; the size, place, contrast and noise here are ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draw import Labels, draw_objects, normal, per_image, places, smooth_noise, to_grey, uniform

SIDE_PX = 64
CLASSES = ("background", "event")
UNEVENNESS = 0.25
UNEVEN_PX = 16.0
POWER = (0.7, 1.3)
MEAN_AMPLITUDE = 0.42
NOISE = 0.012
PEAK = (0.18, 0.32)
OBJECT_PX = (2.0, 3.0)
REACH_PX = 20.0


def draw(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` frames, uint8 (n, 64, 64) amplitudes and int64 (n,): 1 is an event (OUR generator)."""
    return draw_objects(seed, "transient", part, n, 2, _chunk)


def _chunk(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    n = len(labels)
    slow = np.clip(1 + UNEVENNESS * smooth_noise(rng, n, SIDE_PX, SIDE_PX, UNEVEN_PX), 0.3, 1.9)
    background = slow * MEAN_AMPLITUDE * per_image(np.sqrt(uniform(rng, *POWER, n)))
    v, u = places(
        *(SIDE_PX, SIDE_PX),
        uniform(rng, -REACH_PX, REACH_PX, n),
        uniform(rng, -REACH_PX, REACH_PX, n),
        uniform(rng, 0, np.pi, n),
    )
    size_px = uniform(rng, *OBJECT_PX, n)
    event = np.exp(-0.5 * ((u / per_image(size_px)) ** 2 + (v / per_image(size_px * uniform(rng, 1, 1.6, n))) ** 2))
    sign = rng.choice(np.array([-1, 1], np.float32), n)
    peak = uniform(rng, *PEAK, n) * sign * (labels == 1)
    return to_grey(background + per_image(peak.astype(np.float32)) * event + NOISE * normal(rng, *slow.shape))
