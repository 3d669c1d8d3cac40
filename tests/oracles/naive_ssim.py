"""Slow oracle for structural similarity: one window at a time, plain loops over Python numbers."""

import math
from collections.abc import Sequence

HALF = 5
SIGMA = 1.5


def ssim_map(x: Sequence[Sequence[float]], y: Sequence[Sequence[float]]) -> list[list[float]]:
    """SSIM of every pixel of two images in [0, 1]; the window sees black beyond the edge."""
    height, width = len(x), len(x[0])
    offsets = [(i, j) for i in range(-HALF, HALF + 1) for j in range(-HALF, HALF + 1)]
    raw = {(i, j): math.exp(-(i * i + j * j) / (2 * SIGMA**2)) for i, j in offsets}
    total = math.fsum(raw.values())
    result = []
    for row in range(height):
        line = []
        for column in range(width):
            seen = []
            for i, j in offsets:
                inside = 0 <= row + i < height and 0 <= column + j < width
                a = x[row + i][column + j] if inside else 0.0
                b = y[row + i][column + j] if inside else 0.0
                seen.append((raw[i, j] / total, a, b))
            mean_x = math.fsum(w * a for w, a, _ in seen)
            mean_y = math.fsum(w * b for w, _, b in seen)
            var_x = math.fsum(w * (a - mean_x) ** 2 for w, a, _ in seen)
            var_y = math.fsum(w * (b - mean_y) ** 2 for w, _, b in seen)
            both = math.fsum(w * (a - mean_x) * (b - mean_y) for w, a, b in seen)
            line.append(
                (2 * mean_x * mean_y + 1e-4)
                * (2 * both + 9e-4)
                / ((mean_x**2 + mean_y**2 + 1e-4) * (var_x + var_y + 9e-4))
            )
        result.append(line)
    return result
