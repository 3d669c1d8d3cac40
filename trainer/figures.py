"""Figures as small PNG files (extra `plot`), without a screen: a new one with its axes, and saving it."""

from __future__ import annotations

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


def save_figure(figure: Any, path: Path, *, force: bool = True) -> None:
    """Write `figure` to `path` (PNG), whole or not at all; without `force`, UsageError if `path` exists."""
    from matplotlib import pyplot

    with whole_file(path, force=force) as beside:
        figure.savefig(beside, dpi=DPI, format="png")
    pyplot.close(figure)
