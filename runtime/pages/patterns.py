"""The section on patterns: each large enough to be seen, with its light, how often it clicked, and what a click on it means.

What a click means is counted, not modelled: how often the objects of each true class made it click.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.grey_png import png_bytes
from pans.runtime.intervals import wilson_interval

from .page import Page, Picture
from .rates import Rates

PATTERNS_MAX = 48
SIDE_MAX = 96  # pixels of a picture's side
CLASSES_NAMED = 2
LEAST_EXPOSURES = 20  # of a class, before anything is said about it
F64 = NDArray[np.float64]


def grey_png(values: F64, low: float, high: float) -> bytes:
    """Return a pattern (height, width) as a picture, `low` black and `high` white; large ones are thinned."""
    step = -(-max(values.shape) // SIDE_MAX)
    share = (values[::step, ::step] - low) / ((high - low) or 1.0)
    return png_bytes(np.round(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8))


def shown_values(bundle: Bundle) -> tuple[F64, str]:
    """Return what is shown (n, height, width), or the modulus of the passive optics' rows, and its unit."""
    if bundle.analyser is None:
        return bundle.patterns().reshape(-1, *bundle.image_shape), "photoelectrons per exposure and unit transmission"
    matrix = np.abs(bundle.analyser.matrix).astype(np.float64)
    return matrix.reshape(-1, *bundle.image_shape), "modulus of W"


def add_patterns(page: Page, bundle: Bundle, rates: Rates | None = None) -> None:
    """Add the fixed patterns, or the rows of passive optics; with a run's `rates` also what a click on each means."""
    values, unit = shown_values(bundle)
    shown = values[:PATTERNS_MAX]
    name = "pattern" if bundle.analyser is None else "row"
    pictures = []
    for number, value in enumerate(shown):
        lines = [] if rates is None else meaning(rates, number, bundle.classes)
        if bundle.analyser is None:
            lines.append(f"light {value.sum():.4g}, brightest pixel {value.max():.3g}")
        pictures.append(Picture(grey_png(value, 0.0, float(value.max()) or 1.0), f"{name} {number}", lines))
    page.pictures(pictures, _caption(bundle, len(shown), len(values), unit, rates is not None))


def _caption(bundle: Bundle, shown: int, n: int, unit: str, measured: bool) -> str:
    more = f" The first {shown} of {n} are shown." if shown < n else ""
    words = f"Black is 0, white is each one's brightest pixel, in {unit}.{more}"
    if bundle.analyser is None:
        words += f" In {bundle.levels} whole levels; all together send {bundle.illumination():.4g}, the illumination of one shot."
    if measured:
        words += " Clicks are counted in this run: how often objects of each true class made the detector click."
    return words


def meaning(rates: Rates, number: int, classes: tuple[str, ...]) -> list[str]:
    """Return how often pattern `number` clicked, and with which classes most and least often."""
    exposures, clicks = float(rates.exposures[:, number].sum()), float(rates.clicks[:, number].sum())
    if not exposures:
        return ["never shown"]
    low, high = wilson_interval(int(clicks), int(exposures))
    lines = [f"clicked in {100 * clicks / exposures:.1f} % of exposures ({100 * low:.1f} to {100 * high:.1f} %)"]
    if number >= len(rates.class_exposures) or rates.class_exposures.shape[1] != len(classes):
        return lines
    seen = rates.class_exposures[number]
    known = np.flatnonzero(seen >= LEAST_EXPOSURES)
    if len(known) < 2:
        return lines
    share = rates.class_clicks[number][known] / seen[known]
    order = known[np.argsort(-share)]
    named = [f"{classes[one]} {100 * rates.class_clicks[number][one] / seen[one]:.0f} %" for one in order]
    return [*lines, f"most with {', '.join(named[:CLASSES_NAMED])}", f"least with {named[-1]}"]
