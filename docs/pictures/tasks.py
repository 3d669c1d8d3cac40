"""Draw docs/pictures/task_*.png: some held-out objects of every class, with their mean intensity (extras `train` and `plot`).

python docs/pictures/tasks.py FOLDER [DATA]

One PNG per drawn task, and with a data folder (holding mnist/) the fibre's speckle as well.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pans.bundle.sensor import incident_intensity
from pans_trainer.tasks.generators import GENERATORS
from pans_trainer.tasks.registry import draw_task, load_task

PER_CLASS = 8
DPI = 70
GREY_LEVELS = 32  # keeps the files small


def picture_of(name: str, path: Path) -> None:
    """Write the picture of a drawn task: rows are classes, grey levels as they are (0 to 255, each image to its own peak)."""
    drawn = draw_task(name, n_train=1, n_test=60)
    rows: list[tuple[str, NDArray[Any], NDArray[Any] | None]] = []
    for label, title in enumerate(drawn.classes):
        images = drawn.test.images[drawn.test.labels == label][:PER_CLASS]
        rows.append((title, images, incident_intensity(images, drawn.light, "none").mean(axis=(1, 2))))
    _write(rows, path, flat=drawn.image_shape[0] == 1)


def picture_of_fibre(path: Path, data_dir: Path) -> None:
    """Write digits and the speckle behind the fibre."""
    test = load_task("mmf-mnist", data_dir).test.images[:PER_CLASS]
    speckle = incident_intensity(test, "field", "mmf")
    _write([("digit", test, None), ("speckle", speckle, speckle.mean(axis=(1, 2)))], path, flat=False)


def _write(rows: list[tuple[str, NDArray[Any], NDArray[Any] | None]], path: Path, *, flat: bool) -> None:
    import matplotlib as mpl
    from PIL import Image

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    height = 0.5 if flat else 1.35
    figure, axes = plt.subplots(len(rows), PER_CLASS, figsize=(1.25 * PER_CLASS, height * len(rows)), squeeze=False)
    for line, (title, images, means) in zip(axes, rows):
        for i, place in enumerate(line):
            place.imshow(images[i], cmap="gray", vmin=0, aspect="auto" if flat else "equal")
            place.set_xticks([])
            place.set_yticks([])
            if means is not None:
                place.set_title(f"{means[i]:.3f}", fontsize=7, pad=2)
        line[0].set_ylabel(title, fontsize=8, rotation=0 if flat else 90, ha="right" if flat else "center")
    figure.tight_layout(pad=0.4)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    with Image.open(path) as picture:
        small = picture.convert("L").quantize(GREY_LEVELS)
    small.save(path, optimize=True)


def main(arguments: list[str]) -> None:
    """Write all pictures into the folder named first; with a data folder named second, the fibre's too."""
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name in GENERATORS:
        if name != "cells-3":
            picture_of(name, folder / f"task_{name}.png")
    if len(arguments) > 1:
        picture_of_fibre(folder / "task_mmf.png", Path(arguments[1]))


if __name__ == "__main__":
    main(sys.argv[1:])
