"""Cells of three classes in flow, and a bundle that tells them apart."""

from pathlib import Path

import numpy as np
from bundles import made_bundle

from pans.bundle.sensor.bundle import write_bundle

SIDE = 16


def write_thirds(path: Path) -> Path:
    """Cells of three classes, one third of the picture's rows lit for each, and patterns that tell the thirds apart, as files in `path`."""
    images = np.zeros((6, SIDE, SIDE), np.uint8)
    for n in range(6):
        images[n, 5 * (n % 3) : 5 * (n % 3) + 5, 4:12] = 200 + 10 * (n // 3)
    np.savez(
        path / "cells.npz", images=images, labels=np.arange(6, dtype=np.int16) % 3, classes=np.array(["a", "b", "c"])
    )
    (path / "cells.toml").write_text(
        'kind = "cells"\nimages = "cells.npz"\nrate_hz = 2000.0\nvelocity_fields_per_s = 20000.0\nvelocity_spread = 0.05\noffset_px = 0\n'
    )
    (path / "flow.toml").write_text('kind = "cells"\nfields_per_s = 20000.0\nonset_frames = 4\n')
    levels = np.zeros((3, SIDE, SIDE), np.uint16)
    for third in range(3):
        levels[third, 5 * third : 5 * third + 5, 4:12] = 16
    levels[0, 0, 0] = 255
    words = (np.arange(8)[:, None] >> np.arange(3)) & 1
    bundle = made_bundle(
        name="thirds",
        classes=("a", "b", "c"),
        image_shape=(SIDE, SIDE),
        levels=256,
        pattern_levels=levels.reshape(3, -1),
        photons_per_level=4.0 / 255,  # 2 us at the profile's light
        table=(4.0 * words).astype(np.float32),
    )
    write_bundle(bundle, path / "thirds.pans")
    return path
