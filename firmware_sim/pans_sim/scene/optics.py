"""From projector levels and objects to light: expected photoelectrons of every object under every pattern, once per pattern set.

Only what the profile declares is modelled: the projector's photon scale, the object modulator where there is one, and where a scene's
images stand on the grid of the patterns (pans.instrument.optics); or passive optics, as a bundle states them.
On perfect optics sums of level times grey are integers below 2^53: exact, whatever the BLAS, its threads and the block size are.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pans.bundle.sensor import Analyser
from pans.instrument.optics import levelled, met
from pans.instrument.profile import Profile

from .still import Scene

MAX_TABLE_ENTRIES = 1 << 22  # 32 MiB of float64, a few times over
_VALUES_PER_BLOCK = 1 << 20  # of float64 copies of patterns and pictures: 8 MiB each


def photons_per_level(profile: Profile, exposure_us: float) -> float:
    """Photoelectrons per exposure and unit transmission for one level of one pixel (detector efficiency inside)."""
    return profile.projector.peak_photoelectrons_hz * exposure_us * 1e-6 / (profile.projector.levels - 1)


def expected_photoelectrons(
    profile: Profile, scene: Scene, pattern_levels: NDArray[np.uint16], exposure_us: float
) -> NDArray[np.float64]:
    """Return lambda, float64 (n_objects, n_patterns): photoelectrons per exposure of each object under each pattern.

    `pattern_levels` is uint16 (n_patterns, n_pixels); the transmission is that of `clicks.object_transmission`. ValueError
    when the patterns do not fit the scene's images, or the table would exceed MAX_TABLE_ENTRIES.
    """
    n_patterns, n_pixels = pattern_levels.shape
    if not scene.any_shape and scene.n_pixels != n_pixels:
        height, width = scene.images.shape[1:]
        raise ValueError(
            f"patterns have {n_pixels} pixels, scene {scene.name!r} has {scene.n_pixels} ({height} x {width})"
        )
    if scene.n_objects * n_patterns > MAX_TABLE_ENTRIES:
        raise ValueError(
            f"{scene.n_objects} objects x {n_patterns} patterns: the simulator's table holds {MAX_TABLE_ENTRIES} entries"
        )
    if not scene.lit:
        return np.zeros((scene.n_objects, n_patterns))
    if not scene.imaging.is_identity:
        return _imaged(profile, scene, pattern_levels) * photons_per_level(profile, exposure_us)
    t_min = profile.min_transmission
    total = pattern_levels.sum(axis=1, dtype=np.uint64).astype(np.float64)
    grey, white = grey_steps(profile)
    light = _grey_sums(scene, grey, pattern_levels, total)
    light /= white  # in place from here on: the table may be large
    light *= 1.0 - t_min
    light += t_min * total
    light *= photons_per_level(profile, exposure_us)
    return light


def patterns_met(
    profile: Profile, scene: Scene, pattern_levels: NDArray[np.uint16], exposure_us: float
) -> NDArray[np.float64]:
    """Return what each object pixel receives of each pattern, float64 (patterns, pixels), in photoelectrons per unit transmission.

    ValueError for patterns that do not fit the scene.
    """
    n_pixels, imaging = pattern_levels.shape[1], scene.imaging
    if not scene.any_shape and n_pixels != scene.n_pixels:
        raise ValueError(f"patterns have {n_pixels} pixels, scene {scene.name!r} has {scene.n_pixels}")
    levels, full = pattern_levels.astype(np.float64), profile.projector.levels - 1.0
    if scene.any_shape:  # a target fills the field: neither shift nor blur change it
        shape = (1, n_pixels) if imaging.flat is None else imaging.flat.shape
        light = levelled(imaging, levels, (shape[0], shape[1]), full)
    else:
        height, width = scene.images.shape[1:]
        light = met(imaging, levels, (height, width), full)
    return light * photons_per_level(profile, exposure_us)


def transmissions(profile: Profile, scene: Scene, numbers: NDArray[np.int64], n_pixels: int) -> NDArray[np.float64]:
    """Return the transmission of the objects `numbers` (n,) of the scene, float64 (n, pixels); a target has any number of pixels."""
    grey, white = grey_steps(profile)
    clear = profile.min_transmission + (1.0 - profile.min_transmission) * grey / white
    found = clear[scene.images[numbers].reshape(len(numbers), -1)]
    return np.ascontiguousarray(np.broadcast_to(found, (len(numbers), n_pixels)))


def _imaged(profile: Profile, scene: Scene, pattern_levels: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Level times transmission, float64 (n_objects, n_patterns), where the scene's images stand as `scene.imaging` says.

    A target fills the field and what lies around it, so that neither shift nor blur change it.
    """
    imaging, full = scene.imaging, profile.projector.levels - 1.0
    grey, white = grey_steps(profile)
    clear = profile.min_transmission + (1.0 - profile.min_transmission) * grey / white
    levels = pattern_levels.astype(np.float64)
    if scene.any_shape:
        shape = (1, levels.shape[1]) if imaging.flat is None else imaging.flat.shape
        total = levelled(imaging, levels, (shape[0], shape[1]), full).sum(axis=1)
        return np.asarray(clear[scene.images.reshape(-1, 1)] * total)
    height, width = scene.images.shape[1:]
    as_met = met(imaging, levels, (height, width), full).T
    light = np.empty((scene.n_objects, len(levels)))
    at_once = max(1, _VALUES_PER_BLOCK // scene.n_pixels)
    for first in range(0, scene.n_objects, at_once):
        part = scene.images[first : first + at_once]
        light[first : first + at_once] = clear[part.reshape(len(part), -1)] @ as_met
    return light


def passive_photoelectrons(analyser: Analyser, scene: Scene, exposure_us: float) -> NDArray[np.float64]:
    """Return lambda, float64 (n_objects, n_detectors): photoelectrons per exposure behind passive optics; ValueError as above.

    A target fills the field with full scale; light grows with the exposure.
    """
    n_detectors, n_pixels = analyser.matrix.shape
    images = scene.images
    if scene.any_shape:
        side = math.isqrt(n_pixels)
        shape = (side, side) if side * side == n_pixels else (1, n_pixels)
        images = np.broadcast_to(images, (len(images), *shape))
    elif scene.n_pixels != n_pixels:
        raise ValueError(f"the passive optics see {n_pixels} pixels, scene {scene.name!r} has {scene.n_pixels}")
    if not scene.lit:
        return np.zeros((scene.n_objects, n_detectors))
    return analyser.photoelectrons(images) * (exposure_us / analyser.exposure_us)


def grey_steps(profile: Profile) -> tuple[NDArray[np.float64], int]:
    """What the modulator makes of the 256 grey values, in whole steps, and its step number of white."""
    modulator = profile.object_modulator
    if modulator is None or modulator.levels >= 256:
        return np.arange(256.0), 255
    return np.rint(np.arange(256) / 255.0 * (modulator.levels - 1)), modulator.levels - 1


def _grey_sums(
    scene: Scene, grey: NDArray[np.float64], pattern_levels: NDArray[np.uint16], total: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sum of level times grey step, an exact integer: float64 (n_objects, n_patterns)."""
    if scene.any_shape:
        return grey[scene.images.reshape(-1, 1)] * total
    n_patterns, n_pixels = pattern_levels.shape
    sums = np.zeros((scene.n_objects, n_patterns))
    at_once = max(1, _VALUES_PER_BLOCK // n_patterns)
    for first in range(0, n_pixels, at_once):
        levels = pattern_levels[:, first : first + at_once].astype(np.float64).T
        lit = np.flatnonzero(levels.any(axis=1))  # trained patterns are dark nearly everywhere: dark pixels add nothing
        _add_pixels(scene, grey, levels[lit], first + lit, sums)
    return sums


def _add_pixels(
    scene: Scene, grey: NDArray[np.float64], seen: NDArray[np.float64], lit: NDArray[np.intp], sums: NDArray[np.float64]
) -> None:
    """Add to the sums of all objects what comes through the pixels `lit`, which have the levels `seen` (pixels, patterns)."""
    at_once = max(1, _VALUES_PER_BLOCK // max(1, len(lit)))
    for first in range(0, scene.n_objects, at_once):
        images = scene.images[first : first + at_once]
        sums[first : first + at_once] += grey[images.reshape(len(images), -1)[:, lit]] @ seen
