"""Drawing primitives that the task generators share: random streams, soft shapes, smooth noise, speckle, grey levels.

Images are float32 (n, height, width); coordinates are pixels, y down and x right, with the origin in the middle of the frame. Objects are
drawn in chunks of `CHUNK`, each with its own random stream: object i of a seed is the same however many are asked for, and the held-out
objects come from other streams than the training objects. Another version of numpy or another processor may round a few pixels to the
neighbouring grey level.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

CHUNK = 60  # objects drawn together; a multiple of 2, 3, 4, 5 and 6 classes, so that every chunk is balanced, and small
# enough for its images to stay in the cache

Floats = NDArray[np.floating[Any]]  # float32 throughout
Labels = NDArray[np.int64]
DrawChunk = Callable[[np.random.Generator, Labels], NDArray[np.uint8]]


def random_stream(seed: int, name: str, part: str, chunk: int) -> np.random.Generator:
    """Return the generator of one chunk: SeedSequence of the seed, the task's name and part (by SHA-256) and the chunk."""
    words = np.frombuffer(hashlib.sha256(f"{name}/{part}".encode()).digest(), "<u4")
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *words.tolist(), chunk])))


def draw_objects(
    seed: int, name: str, part: str, n: int, n_classes: int, draw_chunk: DrawChunk
) -> tuple[NDArray[np.uint8], Labels]:
    """Return `n` labelled images, uint8 (n, height, width) and int64 (n,), classes in equal shares and random order."""

    def one(chunk: int) -> tuple[NDArray[np.uint8], Labels]:
        rng = random_stream(seed, name, part, chunk)
        labels = rng.permutation(np.arange(CHUNK, dtype=np.int64) % n_classes)
        return draw_chunk(rng, labels), labels

    allowed = os.environ.get("OMP_NUM_THREADS", "")
    threads = int(allowed) if allowed.isdigit() and int(allowed) > 0 else os.cpu_count() or 1
    with ThreadPoolExecutor(threads) as pool:  # numpy leaves the interpreter free; the streams do not depend on order
        chunks = list(pool.map(one, range(-(-n // CHUNK))))
    return np.concatenate([images for images, _ in chunks])[:n], np.concatenate([labels for _, labels in chunks])[:n]


def uniform(rng: np.random.Generator, low: float, high: float, *shape: int) -> Floats:
    """Return uniform random numbers, float32, of `shape`."""
    return (low + (high - low) * rng.random(shape, dtype=np.float32)).astype(np.float32)


def normal(rng: np.random.Generator, *shape: int) -> Floats:
    """Return standard normal random numbers, float32, of `shape`."""
    return rng.standard_normal(shape, dtype=np.float32)


def per_image(values: Floats) -> Floats:
    """Return (n,) values as (n, 1, 1), to scale images with."""
    return values[:, None, None]


# ---- places ----


def axis(size: int) -> Floats:
    """Return the pixel centres along one side, float32 (size,), zero in the middle."""
    return (np.arange(size) - (size - 1) / 2).astype(np.float32)


def places(side: int, centre_y: Floats, centre_x: Floats, angle: Floats) -> tuple[Floats, Floats]:
    """Return pixel coordinates (v, u), each (n, side, side), in frames centred and turned per image (radians)."""
    y, x = axis(side)[None, :, None] - per_image(centre_y), axis(side)[None, None, :] - per_image(centre_x)
    cos, sin = per_image(np.cos(angle)), per_image(np.sin(angle))
    return (y * cos - x * sin).astype(np.float32), (y * sin + x * cos).astype(np.float32)


def waviness(rng: np.random.Generator, sin: Floats, cos: Floats, orders: range, strength: float) -> Floats:
    """Return sum_k a_k cos(k theta + phase) per image, of the angles with these sines and cosines (n, height, width).

    a_k is normal, of standard deviation strength / k; k runs through `orders`, rising by one.
    """
    wave, cos_k, sin_k = np.zeros_like(cos), np.ones_like(cos), np.zeros_like(cos)
    for k in range(1, orders.stop):
        cos_k, sin_k = cos_k * cos - sin_k * sin, sin_k * cos + cos_k * sin
        if k in orders:
            a, phase = normal(rng, len(cos)) * (strength / k), uniform(rng, 0, 2 * np.pi, len(cos))
            wave += per_image(a * np.cos(phase)) * cos_k - per_image(a * np.sin(phase)) * sin_k
    return wave


# ---- shapes ----


def soft_inside(signed_distance: Floats, edge_px: float | Floats) -> Floats:
    """Return 1 where `signed_distance` (pixels) is far below 0, 0 far above it, a smooth step of about `edge_px` between."""
    return (0.5 - 0.5 * np.tanh(signed_distance / edge_px)).astype(np.float32)


def bell(distance: Floats, sigma: float | Floats) -> Floats:
    """Return exp(-distance**2 / (2 sigma**2)), level from exp(-20) on: products of subnormal numbers are slow."""
    return np.exp(-np.minimum(0.5 * (distance / sigma) ** 2, 20)).astype(np.float32)


def spots(height: int, width: int, y: Floats, x: Floats, sigma: Floats, weight: Floats) -> Floats:
    """Return the sum of round Gaussian spots, (n, height, width); y, x, sigma (pixels) and weight are (n, spots).

    Each spot is added in a square of 4.5 sigma of the widest around it (no linear algebra library, whose threads would fight).
    """
    n = len(y)
    reach = np.arange(-(half := int(np.ceil(4.5 * sigma.max()))), half + 1)
    rows, row_index = _profiles(y + (height - 1) / 2, sigma, reach, height)
    columns, column_index = _profiles(x + (width - 1) / 2, sigma, reach, width)
    patches = (rows * weight[:, :, None])[:, :, :, None] * columns[:, :, None, :]
    first = np.arange(n)[:, None, None, None] * (height * width)
    index = first + row_index[:, :, :, None] * width + column_index[:, :, None, :]
    return np.bincount(index.ravel(), patches.ravel(), n * height * width).reshape(n, height, width).astype(np.float32)


def _profiles(centre: Floats, sigma: Floats, reach: NDArray[np.int64], size: int) -> tuple[Floats, NDArray[np.int64]]:
    """Return the profiles of spots along one side, (n, spots, reach), 0 outside the frame, and the pixels they belong to."""
    pixel = np.rint(centre).astype(np.int64)[:, :, None] + reach
    profile = bell(pixel - centre[:, :, None], sigma[:, :, None]) * ((pixel >= 0) & (pixel < size))
    return profile, np.clip(pixel, 0, size - 1)


def some_of(rng: np.random.Generator, n: int, low: int, high: int) -> Floats:
    """Return a mask (n, high), 1 for the first k spots of an image and 0 after them, k uniform from `low` to `high`."""
    kept = rng.integers(low, high + 1, (n, 1))
    return (np.arange(high)[None, :] < kept).astype(np.float32)


# ---- random textures ----


def smooth_noise(rng: np.random.Generator, n: int, side: int, grain_px: float) -> Floats:
    """Return Gaussian noise (n, side, side) smoothed over `grain_px` (sigma), mean 0, expected variance 1; periodic at the edges."""
    transfer = _gaussian_transfer(side, side, grain_px)
    return _filtered(normal(rng, n, side, side), transfer / np.sqrt((transfer**2).mean()))


def cloud_noise(rng: np.random.Generator, n: int, side: int, slope: float) -> Floats:
    """Return noise (n, side, side) with amplitudes falling as 1 / frequency**slope (turbulent clouds), mean 0, variance 1; periodic."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)[None, :])
    frequency[0, 0] = 1.0
    transfer = frequency**-slope
    transfer[0, 0] = 0.0
    return _filtered(normal(rng, n, side, side), transfer / np.sqrt((transfer**2).mean()))


def speckle(rng: np.random.Generator, n: int, height: int, width: int, grain_px: float) -> NDArray[np.complex64]:
    """Return fully developed speckle, complex64 (n, height, width), of mean intensity 1; periodic at the edges.

    A circular Gaussian field behind a round pupil; a grain (first zero of its correlation) is about `grain_px` wide.
    """
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None, :])
    pupil = frequency <= 0.61 / grain_px
    n_modes = int(pupil.sum())
    spectrum = np.zeros((n, height, width), np.complex64)
    spectrum[:, pupil] = normal(rng, n, n_modes) + 1j * normal(rng, n, n_modes)
    return (np.fft.ifft2(spectrum) * (height * width / np.sqrt(2 * n_modes))).astype(np.complex64)


def blur(images: Floats, sigma_px: float) -> Floats:
    """Return images behind a Gaussian point spread of `sigma_px`; periodic at the edges, the mean is kept."""
    return _filtered(images, _gaussian_transfer(images.shape[1], images.shape[2], sigma_px))


def _filtered(images: Floats, transfer: NDArray[np.float64]) -> Floats:
    height, width = images.shape[1:]
    half = transfer[:, : width // 2 + 1].astype(np.float32)  # in single precision, where numpy has it
    return np.fft.irfft2(np.fft.rfft2(images) * half, s=(height, width)).astype(np.float32)


def _gaussian_transfer(height: int, width: int, sigma_px: float) -> NDArray[np.float64]:
    square = np.fft.fftfreq(height)[:, None] ** 2 + np.fft.fftfreq(width)[None, :] ** 2
    return np.exp(-2 * (np.pi * sigma_px) ** 2 * square)


# ---- brightness ----


def with_mean(images: Floats, mean: Floats) -> Floats:
    """Return non-negative images scaled so that image i has the mean `mean[i]`: brightness then tells no class."""
    images = np.maximum(images, 0)
    found = images.mean(axis=(1, 2))
    return images * per_image(mean / np.maximum(found, 1e-12))


def to_grey(images: Floats) -> NDArray[np.uint8]:
    """Return images of nominal range 0..1 as 8-bit grey, rounded; what is beyond the range saturates."""
    return np.clip(np.rint(images * 255), 0, 255).astype(np.uint8)
