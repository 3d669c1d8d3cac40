"""The optics as a linear map: objects as the pattern grid meets them, and patterns as the object meets them (the adjoint).

An object is constant over each of its pixels; a pattern pixel meets the mean, over its own square, of the object
after magnification, rotation, shift and blur. The weight of an object pixel is the integral of the Gaussian over both squares, in closed
form per axis of the object. That is exact for every shift, magnification and blur, and for rotations by multiples of 90 degrees. At other
angles the square of the pattern pixel keeps the object's orientation: its centre is exact, its second moments are too, as those of
a square do not depend on the orientation. Without blur and magnification the weights are those of bilinear interpolation.
Outside of the object there is no light. Light that falls outside of the grid is lost.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .model import Imaging

FEW_OBJECTS, WEIGHTS_AT_ONCE = 4, 1 << 21  # so few objects are met tap by tap, faster than by the matrix
PIXELS_DENSE = 4096  # beyond it the matrix of all pairs of pixels would take more than 128 MiB
REACH_SIGMA = 8.3  # beyond it the tail of a Gaussian is below the resolution of float64
_OBJECTS_AT_ONCE = 2048
_KNOTS_PER_UNIT, _TABLE_END = 64, 9.0  # of the table of Gaussian tails

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Shape = tuple[int, int]


def seen(imaging: Imaging, images: F64, shape: Shape) -> F64:
    """Return transmissions (objects, rows * columns) as the pattern grid of `shape` (rows, columns) meets them, float64.

    Perfect optics give the numbers of `images` unchanged. ValueError for another number of pixels.
    """
    pixels = np.asarray(images, np.float64)
    if pixels.ndim != 2 or pixels.shape[1] != shape[0] * shape[1] or min(shape) < 1:
        raise ValueError(f"images are {pixels.shape}, allowed: (objects, {shape[0]} * {shape[1]})")
    if imaging.in_place:
        return pixels.copy()
    if imaging.rotation_deg == 0:
        down, along = _axis(imaging, shape[0], imaging.down_px), _axis(imaging, shape[1], imaging.right_px)
        return np.asarray(down @ pixels.reshape(-1, *shape) @ along.T).reshape(len(pixels), -1)
    if len(pixels) <= FEW_OBJECTS:
        return _gathered(imaging, pixels, shape)
    if shape[0] * shape[1] <= PIXELS_DENSE:
        return np.asarray(pixels @ operator(imaging, shape).T)
    return _gathered(imaging, pixels, shape)


def operator(imaging: Imaging, shape: Shape) -> F64:
    """Return the matrix (rows * columns of the grid, rows * columns of the object) of `seen`; its transpose is the adjoint.

    ValueError for more than `PIXELS_DENSE` pixels.
    """
    rows, columns = shape
    n = rows * columns
    if min(shape) < 1 or n > PIXELS_DENSE:
        raise ValueError(f"the matrix of {rows} x {columns} pixels, allowed: up to {PIXELS_DENSE} pixels")
    if imaging.in_place:
        return np.eye(n)
    if imaging.rotation_deg == 0:
        down, along = _axis(imaging, rows, imaging.down_px), _axis(imaging, columns, imaging.right_px)
        return np.asarray(np.kron(down, along), np.float64)
    (row, row_weight), (column, column_weight) = _taps(imaging, shape)
    matrix = np.zeros((n, n))
    inside = _inside(row, rows)[:, :, None] & _inside(column, columns)[:, None, :]
    grid, above, aside = np.nonzero(inside)
    matrix[grid, row[grid, above] * columns + column[grid, aside]] = (
        row_weight[grid, above] * column_weight[grid, aside]
    )
    return matrix


def levelled(imaging: Imaging, patterns: F64, shape: Shape, peak: F64 | float = 1.0) -> F64:
    """Return the light of every pattern pixel, float64 (patterns, pixels): gain * flat * (black * peak + (1 - black) * pattern).

    `peak` is the light of a full pixel, of all patterns or (patterns, 1) of each. A pattern without a lit pixel gets the black level
    too: the light is on. ValueError when the shapes differ.
    """
    light = np.asarray(patterns, np.float64)
    if light.ndim != 2 or light.shape[1] != shape[0] * shape[1]:
        raise ValueError(f"patterns are {light.shape}, allowed: (patterns, {shape[0]} * {shape[1]})")
    if imaging.flat is not None and imaging.flat.shape != shape:
        raise ValueError(f"the flat field is {imaging.flat.shape}, the patterns are {shape}")
    light = imaging.gain * (imaging.black * np.asarray(peak, np.float64) + (1.0 - imaging.black) * light)
    return light if imaging.flat is None else np.asarray(light * imaging.flat.reshape(-1))


def met(imaging: Imaging, patterns: F64, shape: Shape, peak: F64 | float = 1.0) -> F64:
    """Return patterns as the object meets them, float64 (patterns, pixels): light = met(...) @ transmission.

    The same as levelled(...) @ seen(...).T for every object; arguments as of `levelled`.
    """
    light = levelled(imaging, patterns, shape, peak)
    return light if imaging.in_place else np.asarray(light @ operator(imaging, shape))


def _gathered(imaging: Imaging, pixels: F64, shape: Shape) -> F64:
    """What `seen` returns, tap by tap: for grids whose matrix would be too large."""
    rows, columns = shape
    (row, row_weight), (column, column_weight) = _taps(imaging, shape)
    row_weight, column_weight = row_weight * _inside(row, rows), column_weight * _inside(column, columns)
    row, column = row.clip(0, rows - 1), column.clip(0, columns - 1)
    if len(pixels) <= FEW_OBJECTS and row.size * column.shape[1] <= WEIGHTS_AT_ONCE:
        place = row[:, :, None], column[:, None, :]
        near = (one.reshape(rows, columns)[place] for one in pixels)  # (grid, taps down, taps along)
        return np.array([np.einsum("gd,gda,ga->g", row_weight, taps, column_weight, optimize=True) for taps in near])
    result = np.zeros((len(pixels), rows * columns))
    for first in range(0, len(pixels), _OBJECTS_AT_ONCE):
        part, into = pixels[first : first + _OBJECTS_AT_ONCE], result[first : first + _OBJECTS_AT_ONCE]
        for down in range(row.shape[1]):
            for along in range(column.shape[1]):
                weight = row_weight[:, down] * column_weight[:, along]
                if weight.any():
                    into += part[:, row[:, down] * columns + column[:, along]] * weight
    return result


def _taps(imaging: Imaging, shape: Shape) -> tuple[tuple[I64, F64], tuple[I64, F64]]:
    """Rows and columns of the object that every pattern pixel meets, int64 (grid, taps), each with its weights."""
    rows, columns = shape
    middle_down, middle_along = (rows - 1) / 2, (columns - 1) / 2
    y, x = np.mgrid[0:rows, 0:columns].reshape(2, -1).astype(np.float64)
    x, y = x - middle_along - imaging.right_px, y - middle_down - imaging.down_px
    cosine, sine = _turn(imaging.rotation_deg)
    # rows grow downwards: counter-clockwise on screen takes (right, down) = (1, 0) to (cosine, -sine); this is its inverse
    along = (cosine * x - sine * y) / imaging.scale + middle_along
    down = (sine * x + cosine * y) / imaging.scale + middle_down
    return _near(down, imaging), _near(along, imaging)


def _turn(degrees: float) -> tuple[float, float]:
    """Cosine and sine, exact at multiples of 90 degrees."""
    quarter, rest = divmod(degrees, 90.0)
    if rest == 0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


def _near(place: F64, imaging: Imaging) -> tuple[I64, F64]:
    """Object pixels near every coordinate `place` (grid,) along one axis, (grid, taps), and their weights."""
    width, blur = 1.0 / imaging.scale, imaging.psf_px / imaging.scale
    reach = math.ceil(0.5 + width / 2 + REACH_SIGMA * blur)
    pixel = np.rint(place).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    return pixel, _weight(place[:, None] - pixel, width, blur)


def _inside(pixel: I64, size: int) -> NDArray[np.bool_]:
    return (pixel >= 0) & (pixel < size)


def _axis(imaging: Imaging, size: int, shift: float) -> F64:
    """The map along one axis without rotation, (grid, object)."""
    middle = (size - 1) / 2
    place: F64 = (np.arange(size, dtype=np.float64) - middle - shift) / imaging.scale + middle
    return _weight(place[:, None] - np.arange(size), 1.0 / imaging.scale, imaging.psf_px / imaging.scale)


def _weight(distance: F64, width: float, blur: float) -> F64:
    """Mean over a square of `width` of what a pixel of width 1 at `distance` brings, blurred by a Gaussian of deviation `blur`."""
    low = np.maximum(distance - width / 2, -0.5)
    high = np.minimum(distance + width / 2, 0.5)
    weight = np.maximum(0.0, high - low) / width
    if blur:
        near, far = (1 - width) / 2, (1 + width) / 2
        for sign, offset in ((1.0, far), (-1.0, near), (-1.0, -near), (1.0, -far)):
            weight += sign / width * _rounding(distance + offset, blur)
        np.maximum(weight, 0.0, out=weight)  # differences of numbers near 1e-17
    return weight


def _rounding(place: F64, blur: float) -> F64:
    """The ramp max(0, u) convolved with a Gaussian, less the ramp itself: blur * (phi(z) - |z| Q(|z|)), z = u / blur."""
    z = np.minimum(np.abs(place) / blur, _TABLE_END - 0.5)
    return np.asarray(blur * np.maximum(0.0, _density(z) - z * _tail(z)))


def _density(z: F64) -> F64:
    return np.asarray(np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi))


def _tail(z: F64) -> F64:
    """Q(z), the chance beyond z of a standard normal variable, for 0 <= z < _TABLE_END: Taylor's series about the nearest knot.

    With a step of 1/64 the seventh term is below 1e-16 of the density.
    """
    knot = np.rint(z * _KNOTS_PER_UNIT)
    a = knot / _KNOTS_PER_UNIT
    h = z - a
    series = h * (
        1 + h * (-a / 2 + h * ((a * a - 1) / 6 + h * (-(a * a - 3) * a / 24 + h * (a**4 - 6 * a * a + 3) / 120)))
    )
    return np.asarray(_TAILS[knot.astype(np.int64)] - _density(a) * series)


_TAILS = np.array(
    [0.5 * math.erfc(k / _KNOTS_PER_UNIT / math.sqrt(2)) for k in range(int(_TABLE_END * _KNOTS_PER_UNIT) + 1)]
)
