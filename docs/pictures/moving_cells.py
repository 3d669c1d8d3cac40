"""Draw docs/pictures/moving-cells.png: two cells that cross the light field, channel by channel (needs the extra `plot`).

Run `python docs/pictures/moving_cells.py`. Patterns are blurred random spots, not trained ones; everything is SIMULATED.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from pans.instrument.profile import load_profile
from pans.protocol.wire import PARALLEL
from pans_sim.device.view import View
from pans_sim.scene import open_scene
from pans_sim.scene.marks import MARK_EXPOSURE, MARK_HALF, MARK_OBJECT, MARK_PHOTONS, MARK_TRUTH
from pans_sim.scene.moving import Cells
from pans_sim.scene.program import Program

matplotlib.use("Agg")
from matplotlib import pyplot

EXPOSURE_US, N_PATTERNS, SHOWN_US = 1.0, 6, 150
FILTER = 0.02  # of the profile's light, so that single clicks can be seen
SEED = 5


def spots(rng: np.random.Generator, side: int) -> np.ndarray:
    """Patterns of a few soft spots each, uint16 (patterns, pixels)."""
    y, x = np.mgrid[:side, :side]
    patterns = np.zeros((N_PATTERNS, side, side))
    for pattern in patterns:
        for _ in range(4):
            centre_y, centre_x = rng.uniform(25, side - 25, 2)
            pattern += 30 * np.exp(-((y - centre_y) ** 2 + (x - centre_x) ** 2) / 18)
    return np.rint(np.minimum(patterns, 255)).astype(np.uint16).reshape(N_PATTERNS, -1)


def crossing(light: Any) -> Any:
    """Rows (marks.py) of the first two marks of which the second cell comes into the field before the first has left it."""
    rows = light.take_marks(10_000_000)
    apart = np.diff(rows[:, MARK_EXPOSURE])
    first = int(np.flatnonzero((apart > 25) & (apart < 40))[0])
    return rows[first : first + 2]


def main() -> None:
    profile = load_profile("flow-snspd")
    projector = profile.projector
    projector = replace(projector, peak_photoelectrons_hz=FILTER * projector.peak_photoelectrons_hz)
    profile = replace(profile, projector=projector)
    scene = open_scene("cells-in-flow")
    assert isinstance(scene.what, Cells)
    scene = replace(scene, what=replace(scene.what, rate_hz=4000.0))
    ticks = int(EXPOSURE_US * profile.clock.tick_hz / 1e6)
    plan = Program(
        PARALLEL, N_PATTERNS, ticks, ticks, ticks, 1, np.zeros(1, np.int64), np.zeros(1, np.uint16), ((0, 1),)
    )
    view = View(profile, scene, seed=SEED)
    table = view.tabulate(plan, spots(np.random.default_rng(2), 100))
    marks = crossing(view.light_and_clicks(plan, 0, table)[0])
    first = int(marks[0, MARK_EXPOSURE]) - 60
    rows, row_of = view.light_and_clicks(plan, 0, table)[0].rows(first, SHOWN_US)
    clicks = view.light_and_clicks(plan, 0, table)[1].clicks(first, SHOWN_US, np.zeros(N_PATTERNS, np.uint8))
    draw(rows[row_of], clicks, marks, first, scene.what.objects.classes)


def draw(light: np.ndarray, clicks: np.ndarray, marks: Any, first: int, classes: tuple[str, ...]) -> None:
    figure, (top, bottom) = pyplot.subplots(
        2, 1, figsize=(9, 5), sharex=True, height_ratios=[3, 1], layout="constrained"
    )
    time_us = (np.arange(len(light)) + 0.5) * EXPOSURE_US
    for channel in range(light.shape[1]):
        top.plot(time_us, light[:, channel], label=f"channel {channel}")
        struck = time_us[clicks[:, channel] > 0]
        bottom.plot(struck, np.full(len(struck), channel), "|", ms=8, mew=1.5)
    photons = marks.view(np.float64)[:, MARK_PHOTONS]
    for mark, light_sum, style in zip(marks, photons, ("--", ":")):
        at, half = mark[MARK_EXPOSURE] - first, mark[MARK_HALF]
        for axes in (top, bottom):
            axes.axvline(at + 0.5, color="k", ls=style, lw=1)
            axes.axvspan(at - half, at + half, color="k", alpha=0.06, lw=0)
        words = f"MARK {mark[MARK_OBJECT]}: {classes[mark[MARK_TRUTH]]}\n{light_sum:.2f} photoelectrons"
        top.annotate(
            words,
            (at + 0.5, 1),
            (3, -3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            va="top",
            fontsize=8,
        )
    top.set(ylabel="photoelectrons per exposure of 1 µs", title="SIMULATED: two cells cross the light field")
    top.set_ylim(0, 1.25 * light.max())
    top.legend(fontsize=7, ncols=2, loc="upper left")
    bottom.set_yticks(range(light.shape[1]))
    bottom.set(xlabel="time, µs", ylabel="clicks of channel", ylim=(-0.7, light.shape[1] - 0.3), xlim=(0, SHOWN_US))
    figure.savefig(Path(__file__).with_name("moving-cells.png"), dpi=90)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
