"""Figures as small PNG files (extra `plot`), without a screen: a new one with its axes, and saving it."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

from pans.runtime.outputs import whole_file

DPI = 90


def use_files_alone() -> None:
    """Choose the back end of matplotlib that needs no screen."""
    import matplotlib

    matplotlib.use("Agg")


def new_figure(width: float = 10.0, height: float = 4.0, panels: int = 2, rows: int = 1) -> tuple[Any, Any]:
    use_files_alone()
    from matplotlib import pyplot

    return pyplot.subplots(rows, panels, figsize=(width, height), layout="constrained")


def drawn(figure: Any) -> Any:
    """Return `figure` as a Pillow image of its pixels, RGB."""
    from matplotlib import pyplot
    from PIL import Image

    png = BytesIO()
    figure.savefig(png, dpi=DPI, format="png")
    pyplot.close(figure)
    return Image.open(png).convert("RGB")


def save_figure(figure: Any, path: Path, *, force: bool = True) -> None:
    """Write `figure` to `path`, a PNG of 256 colours, whole or not at all; without `force`, UsageError if `path` exists."""
    from PIL import Image

    with whole_file(path, force=force) as beside:
        # the usual palette leaves out colours of few pixels, such as those of points
        drawn(figure).quantize(256, Image.Quantize.MAXCOVERAGE).save(beside, format="png", optimize=True)
