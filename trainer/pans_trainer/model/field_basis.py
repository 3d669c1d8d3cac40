"""A few fields in which a coherent encoder finds its start: what one class has and the others lack.

Scenes with a bright, fluctuating background defeat an encoder that starts from random weights: its first job is to cancel
the background, and every step of an optimiser in 4096 pixels undoes that. The fields w for which E[(w.x)^2] of one class is largest
against that of the others cancel it from the start: generalised eigenvectors of the second-moment matrices. An encoder
W = C B^T is then trained as C alone: the optimiser moves inside them, and every coordinate has the same size.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .encoders import CoherentField, Encoder

INPUTS_MAX = 1024  # finer images are binned before the eigenvectors are found: 2 x 2 pixels of 64 x 64
RIDGE = 1e-6  # mean square amplitude that is added everywhere: less than an 8-bit step, it keeps the matrices regular


def discriminant_basis(
    fields: Tensor, labels: Tensor, image_shape: tuple[int, int], size: int, *, turned: bool = False
) -> Tensor:
    """Return `size` fields per class, float32 (pixels, classes * size): E[(b.x)^2] of that class largest against the rest.

    `fields` (n, pixels) are real amplitudes; each basis field is scaled to a mean square of 1 over all objects. With `turned` the
    moments are those of every object in all turns and reflections: for scenes without an up, and square images.
    """
    side = max(1, math.ceil(math.sqrt(math.prod(image_shape) / INPUTS_MAX)))
    coarse = _binned(fields, image_shape, side).double()
    regular = RIDGE * torch.eye(coarse.shape[1], dtype=torch.float64)
    found = []
    for label in range(int(labels.max()) + 1):
        parts = coarse[labels == label], coarse[labels != label]
        ours, others = (rows.T @ rows / len(rows) for rows in parts)  # second moments
        if turned:
            ours, others = (_turned(moment) for moment in (ours, others))
        lower = torch.linalg.cholesky(others + regular)
        half = torch.linalg.solve_triangular(lower, ours, upper=False)
        whitened = torch.linalg.solve_triangular(lower, half.T, upper=False)
        vectors = torch.linalg.eigh(0.5 * (whitened + whitened.T)).eigenvectors[:, -size:]
        found.append(torch.linalg.solve_triangular(lower.T, vectors, upper=True))
    basis = torch.cat(found, dim=1)
    basis = basis / (coarse @ basis).square().mean(dim=0).sqrt()
    return _spread(basis, image_shape, side).float()


def turns(image_shape: tuple[int, int]) -> list[Tensor]:
    """Return which pixel stands where, int64 (pixels,), in each of the eight turns and reflections of a square image.

    `image.flatten()[turns(shape)[0]]` is the image itself.
    """
    pixels = torch.arange(math.prod(image_shape)).reshape(image_shape)
    quarters = [torch.rot90(pixels, quarter) for quarter in range(4)]
    return [view.flatten() for quarter in quarters for view in (quarter, quarter.flip(1))]


def in_pixels(encoder: Encoder, basis: Tensor) -> CoherentField:
    """Return the coherent encoder W = C B^T of one whose inputs are the coordinates in `basis` (pixels, size).

    One that conserves light keeps doing so: its basis must be orthonormal, so that W has the singular values of C.
    """
    assert isinstance(encoder, CoherentField)
    parts, n_features, _ = encoder.weight.shape
    whole = CoherentField(
        n_features, len(basis), torch.Generator(), complex_field=parts == 2, conserving=encoder.conserving
    )
    with torch.no_grad():
        whole.weight.copy_(encoder.weight @ basis.T)
    return whole


def _turned(moment: Tensor) -> Tensor:
    side = math.isqrt(len(moment))
    views = turns((side, side))
    return torch.stack([moment[view][:, view] for view in views]).mean(dim=0)


def _binned(fields: Tensor, image_shape: tuple[int, int], side: int) -> Tensor:
    pictures = fields.reshape(-1, 1, *image_shape)
    return torch.nn.functional.avg_pool2d(pictures, side, ceil_mode=True, divisor_override=1).flatten(1)


def _spread(basis: Tensor, image_shape: tuple[int, int], side: int) -> Tensor:
    """The transpose of `_binned`: every pixel of a bin gets its weight."""
    height, width = image_shape
    coarse = basis.T.reshape(-1, -(-height // side), -(-width // side))
    fine = coarse.repeat_interleave(side, dim=1).repeat_interleave(side, dim=2)[:, :height, :width]
    return fine.flatten(1).T.contiguous()
