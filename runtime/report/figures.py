"""Pictures that are files of their own, as PNG bytes (extra `plot`): patterns and reliability; the pages draw theirs themselves.

matplotlib is imported when something is drawn: the lean runtime works without it.
"""

from __future__ import annotations

import importlib
import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import UsageError

F64 = NDArray[np.float64]
DPI = 90
PATTERNS_MAX = 64


def pyplot(what: str = "a report") -> Any:
    """Return matplotlib.pyplot, which draws into memory; UsageError where it is not installed."""
    try:
        importlib.import_module("matplotlib").use("Agg")
        return importlib.import_module("matplotlib.pyplot")
    except ModuleNotFoundError as error:
        raise UsageError(
            f"{what} needs the package matplotlib, which is not installed", remedy="pip install 'pans-runtime[plot]'"
        ) from error


def _new(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Any, Any]:
    return pyplot().subplots(rows, columns, figsize=(width, height), layout="constrained", squeeze=False)


def _done(figure: Any, form: str = "svg") -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format=form, dpi=DPI, metadata={"Date": None} if form == "svg" else None)
    pyplot().close(figure)
    return stream.getvalue()


def reliability(bins: Sequence[tuple[float, float, float]], title: str) -> bytes:
    """Draw accuracy against the probability that was stated, and how many decisions stated it: (probability, accuracy, share) per bin."""
    figure, axes = _new(5.0, 5.4, 2)
    (upper,), (lower,) = axes
    axes[0, 0].get_gridspec().set_height_ratios([3, 1])
    probability, accuracy, share = (np.array(column) for column in zip(*bins)) if bins else (np.zeros(0),) * 3
    upper.plot([0, 1], [0, 1], color="0.6", lw=1, label="as sure as right")
    upper.plot(probability, accuracy, "o-", color="C0", ms=4, label="decisions")
    upper.set(xlim=(0, 1), ylim=(0, 1), ylabel="accuracy")
    upper.set_title(title, fontsize=9)
    upper.legend(fontsize=8)
    lower.bar(probability, share, width=0.04, color="C0")
    lower.set(xlim=(0, 1), xlabel="probability of the decision", ylabel="share")
    return _done(figure, "png")


def patterns(pictures: F64, unit: str) -> bytes:
    """Draw patterns (d_f, height, width) on one scale, at most 64 of them; `unit` names what a pixel's value is."""
    shown = pictures[:PATTERNS_MAX]
    columns = min(8, len(shown))
    rows = math.ceil(len(shown) / columns)
    flatness = max(0.35, min(1.0, shown.shape[1] / shown.shape[2]))
    figure, axes = _new(1.15 * columns + 1.0, 1.3 * rows * flatness + 0.5, rows, columns)
    low, high = float(min(shown.min(), 0.0)), float(shown.max())
    limit = max(-low, high)
    scale = (
        {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit} if low < 0 else {"cmap": "magma", "vmin": 0.0, "vmax": high}
    )
    image = None
    for number, axis in enumerate(axes.flat):
        axis.set_axis_off()
        if number < len(shown):
            image = axis.imshow(shown[number], interpolation="nearest", **scale)
            axis.set_title(str(number), fontsize=7, pad=2)
    figure.colorbar(image, ax=axes, label=unit, shrink=0.8)
    return _done(figure, "png")
