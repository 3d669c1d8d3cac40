"""The optics of the tasks `mmf-mnist` and `mmf-mnist-image`: MNIST digits behind a multimode fibre.

A digit is the field amplitude (grey / 255) at the entrance; the fibre mixes the modes; a passive encoder sees the speckle at its end and
must name the digit, or give back the image. The fibre itself (`scatter`, `phase_mask`) is in `pans.runtime.bundle.optics`: the simulated
instrument looks through the same one. Two inputs for the encoder:

- `scatter`: the complex field at a fixed scale (full scale is 1 at the entrance): the physical default;
- `release_intensity`: the release's way, for comparison: squared modulus, min-max normalised over a batch, taken as a *real
  vector* by a coherent encoder. Two things are unphysical in it: an intensity is no field, and the normalisation lets every image
  depend on the brightest grain of its batch. The release's batch is not known; ours is 128.

With complex encoders the fibre is merely a change of basis; with real ones a feature is (a.x)^2 + (b.x)^2, a and b the two quadratures.
The paper (appendix "MNIST through multimode fiber") calls the matrix random unitary, speaks of grey speckle images as input, 60 000
training and 10 000 test images, and reports SSIM for the images (trainer/model/ssim.py says how it is computed).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.optics import scatter

RELEASE_BATCH = 128


def release_intensity(images: NDArray[np.uint8], batch: int = RELEASE_BATCH) -> NDArray[np.float32]:
    """Return speckle intensities min-max normalised over batches of `batch` images, float32 (n, 28, 28) in [0, 1]."""
    intensity = np.abs(scatter(images)) ** 2
    for start in range(0, len(intensity), batch):
        part = intensity[start : start + batch]
        low, high = part.min(), part.max()
        part -= low
        part /= max(float(high - low), 1e-12)
    return intensity.astype(np.float32, copy=False)
