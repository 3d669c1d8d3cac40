"""OUR generators of the tasks whose grey levels are field amplitudes, 64 x 64 pixels: nebula, fiber, tissue, transient.

docs/reference/tasks.md shows them and says what the paper has instead. Brightness is drawn without regard to the class, so that it tells
nothing alone.

- `nebula`: one or two elliptical shells, brighter towards one side or both poles, with a faint filling and often a star; or turbulent gas
  (amplitude falling as frequency**-1.7, exponentiated) under an irregular envelope, with dark lanes. Both with field stars, sky, seeing
  and noise. The flat phase is the paper's assumption: real nebulae are incoherent.
- `fiber`: the Gaussian mode of a fibre (radius at 1/e), a little elliptical and misaligned. Contaminated end faces have dirt (a round
  patch), pits (a dark ring around a spot that is brighter by a third of its depth) and scratches where the light is; what they shadow is
  taken out, as behind a levelled source.
- `tissue`: fully developed speckle behind a round pupil: a share s of static light, the rest averaged over M independent patterns. The
  classes differ in s and M, that is in their fluctuation: no pixel and no linear sum of intensities differs in mean.
- `transient`: a bright field that varies slowly in space and from frame to frame, with fine noise; an event adds or takes away one compact
  object, in phase or in antiphase. A coherent encoder can dim the slow background by interference; counting light cannot.
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
    smooth_noise,
    soft_inside,
    some_of,
    speckle,
    spots,
    to_grey,
    uniform,
    waviness,
    with_mean,
)

SIDE_PX = 64
NEBULAE = ("planetary", "emission")
NEBULA_INTENSITY = (0.02, 0.045)  # of full scale, drawn log-uniformly
PEAK_TO_MEAN = 20.0
PLACE_PX = 2.0
RADIUS_PX = (9.0, 14.0)
STARS = (2, 8)
STAR_SHARE = (0.03, 0.12)
NEBULA_NOISE = 0.008
END_FACES = ("clean", "contaminated")
MODE_PX = (13.0, 15.0)
MISALIGNED_PX = 1.5
FIBER_INTENSITY = (0.025, 0.05)  # of full scale; the centre of a mode stays below full scale
ROUGHNESS = 0.01
FIBER_NOISE = 0.003
DEFECTS_MAX = 4
PERFUSION = ("static", "perfused")
GRAINS_PX = (3.0, 4.0, 5.0)
PATTERNS_MAX = 12
TISSUE_INTENSITY = (0.065, 0.165)  # of full scale, drawn log-uniformly: bright grains reach five times the mean
EVENTS = ("background", "event")
UNEVENNESS = 0.25
UNEVEN_PX = 16.0
POWER = (0.7, 1.3)
MEAN_AMPLITUDE = 0.42
TRANSIENT_NOISE = 0.012
PEAK = (0.18, 0.32)
OBJECT_PX = (2.0, 3.0)
REACH_PX = 20.0


def draw_nebula(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` nebulae, uint8 (n, 64, 64) amplitudes and int64 (n,): 0 planetary, 1 emission (OUR generator)."""
    return draw_objects(seed, "nebula", part, n, 2, _nebulae)


def _nebulae(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    n = len(labels)
    gas = np.empty((n, SIDE_PX, SIDE_PX), np.float32)
    for label, scene in enumerate((_planetary, _emission)):
        mine = labels == label
        if mine.any():
            gas[mine] = scene(rng, int(mine.sum()))
    share = uniform(rng, *STAR_SHARE, n)
    sky = uniform(rng, 0.02, 0.1, n)
    scene_light = with_mean(gas, 1 - share - sky) + with_mean(_stars(rng, n), share) + per_image(sky)
    mean = np.exp(uniform(rng, *np.log(NEBULA_INTENSITY).tolist(), n))
    seen = with_mean(blur(scene_light, 0.9), np.ones_like(mean))
    seen = with_mean(seen / np.sqrt(1 + (seen / PEAK_TO_MEAN) ** 2), mean)
    return to_grey(np.sqrt(seen) + NEBULA_NOISE * normal(rng, *seen.shape))


class _Frame:
    """Coordinates around a nebula: normalised radius `rho` (1 at its size) and the sine and cosine of the angle."""

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        v, u = places(
            SIDE_PX,
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
    turbulence = cloud_noise(rng, n, SIDE_PX, 1.7)
    lanes = 1 / (1 + np.exp(4 * (cloud_noise(rng, n, SIDE_PX, 1.7) - 0.7)))
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


def draw_fiber(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` end faces, uint8 (n, 64, 64) amplitudes and int64 (n,): 1 is contaminated (OUR generator)."""
    return draw_objects(seed, "fiber", part, n, 2, _end_faces)


def _end_faces(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    n = len(labels)
    centre_y, centre_x = uniform(rng, -MISALIGNED_PX, MISALIGNED_PX, n), uniform(rng, -MISALIGNED_PX, MISALIGNED_PX, n)
    v, u = places(SIDE_PX, centre_y, centre_x, uniform(rng, 0, np.pi, n))
    v = v / per_image(uniform(rng, 0.94, 1, n))
    mode_px = uniform(rng, *MODE_PX, n)
    mode = np.exp(-(u**2 + v**2) / per_image(mode_px) ** 2)
    passed = 1 + ROUGHNESS * smooth_noise(rng, n, SIDE_PX, 1.5)
    many = rng.integers(2, DEFECTS_MAX + 1, n)
    for i in range(DEFECTS_MAX):
        there = (labels == 1) & (many > i)
        r_px, turn = mode_px * np.sqrt(uniform(rng, 0, 0.6, n)), uniform(rng, 0, 2 * np.pi, n)
        depth = _defects(rng, centre_y + r_px * np.sin(turn), centre_x + r_px * np.cos(turn))
        passed *= 1 - depth * per_image(there.astype(np.float32))
    intensity = with_mean((mode * passed) ** 2, uniform(rng, *FIBER_INTENSITY, n))
    return to_grey(np.sqrt(intensity) + FIBER_NOISE * normal(rng, n, SIDE_PX, SIDE_PX))


def _defects(rng: np.random.Generator, y: Floats, x: Floats) -> Floats:
    """Return how much of the amplitude one defect takes, (n, 64, 64): dirt, a pit or a scratch at (y, x) per image."""
    n = len(y)
    kind = per_image(rng.integers(0, 3, n).astype(np.float32))
    v, u = places(SIDE_PX, y, x, uniform(rng, 0, np.pi, n))
    r = np.sqrt(u * u + v * v)
    dirt = per_image(uniform(rng, 0.5, 1.0, n)) * bell(r, per_image(uniform(rng, 2.0, 4.0, n)))
    ring_px = per_image(uniform(rng, 2.0, 4.0, n))
    pit = per_image(uniform(rng, 0.5, 0.9, n)) * (bell(r - ring_px, 1.0) - bell(r, ring_px / 2) / 3)
    along = soft_inside(np.abs(u) - per_image(uniform(rng, 8, 20, n)), 1.0)
    scratch = per_image(uniform(rng, 0.4, 0.8, n)) * bell(v, per_image(uniform(rng, 0.8, 1.4, n))) * along
    return np.where(kind == 0, dirt, np.where(kind == 1, pit, scratch))


def draw_tissue(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` exposures, uint8 (n, 64, 64) root intensities and int64 (n,): 1 is perfused (OUR generator)."""
    return draw_objects(seed, "tissue", part, n, 2, _tissues)


def _tissues(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    n = len(labels)
    static_share = np.where(labels == 1, uniform(rng, 0.0, 0.25, n), uniform(rng, 0.85, 1.0, n))
    n_patterns = np.where(labels == 1, rng.integers(8, PATTERNS_MAX + 1, n), 2)
    intensity = np.empty((n, SIDE_PX, SIDE_PX), np.float32)
    grain = rng.integers(0, len(GRAINS_PX), n)
    for i, grain_px in enumerate(GRAINS_PX):
        mine = grain == i
        if mine.any():
            intensity[mine] = _exposure(rng, static_share[mine], n_patterns[mine], grain_px)
    uneven = np.clip(1 + 0.2 * smooth_noise(rng, n, SIDE_PX, 14.0), 0.3, None)
    mean = np.exp(uniform(rng, *np.log(TISSUE_INTENSITY).tolist(), n))
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


def draw_transient(seed: int, part: str, n: int) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` frames, uint8 (n, 64, 64) amplitudes and int64 (n,): 1 is an event (OUR generator)."""
    return draw_objects(seed, "transient", part, n, 2, _scenes)


def _scenes(rng: np.random.Generator, labels: Labels) -> NDArray[np.uint8]:
    n = len(labels)
    slow = np.clip(1 + UNEVENNESS * smooth_noise(rng, n, SIDE_PX, UNEVEN_PX), 0.3, 1.9)
    background = slow * MEAN_AMPLITUDE * per_image(np.sqrt(uniform(rng, *POWER, n)))
    v, u = places(
        SIDE_PX,
        uniform(rng, -REACH_PX, REACH_PX, n),
        uniform(rng, -REACH_PX, REACH_PX, n),
        uniform(rng, 0, np.pi, n),
    )
    size_px = uniform(rng, *OBJECT_PX, n)
    event = np.exp(-0.5 * ((u / per_image(size_px)) ** 2 + (v / per_image(size_px * uniform(rng, 1, 1.6, n))) ** 2))
    sign = rng.choice(np.array([-1, 1], np.float32), n)
    peak = uniform(rng, *PEAK, n) * sign * (labels == 1)
    return to_grey(background + per_image(peak.astype(np.float32)) * event + TRANSIENT_NOISE * normal(rng, *slow.shape))
