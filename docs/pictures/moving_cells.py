"""Draw docs/pictures/moving-cells.png: two cells that cross the light field, channel by channel (needs the extra `plot`).

Run `python docs/pictures/moving_cells.py`. Patterns are blurred random spots, not trained ones; everything is SIMULATED.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from pans.firmware_sim.program import Program
from pans.firmware_sim.scene.changes import Changes
from pans.firmware_sim.scene.detector import sample_clicks
from pans.firmware_sim.scene.detector_model import detector_model, first_click_probability
from pans.firmware_sim.scene.exposure_times import Exposures
from pans.firmware_sim.scene.light import begin, prepare
from pans.firmware_sim.scene.moving import Cells
from pans.firmware_sim.scene.scene_file import open_scene
from pans.runtime.instrument.profile import load_profile
from pans.runtime.wire.commands import PARALLEL

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


def crossing(run: Any) -> tuple[Any, Any]:
    """The first two marks of which the second cell comes into the field before the first has left it."""
    before = run.mark
    while True:
        run.take_mark()
        if 25 < run.mark.exposure_index - before.exposure_index < 40:
            return before, run.mark
        before = run.mark


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
    table = prepare(profile, scene, spots(np.random.default_rng(2), 100), EXPOSURE_US)

    def run() -> Any:
        exposures = Exposures(plan, None, profile.clock.tick_hz)
        return begin(scene, table, plan, exposures, Changes((), N_PATTERNS), SEED, 0)

    marks = crossing(run())
    first = marks[0].exposure_index - 60
    rows, row_of = run().rows(first, SHOWN_US)
    light = rows[row_of]
    model = detector_model(profile, EXPOSURE_US)
    clicks = sample_clicks(model, first_click_probability(model, light), SEED, first, np.zeros(N_PATTERNS, np.uint8))
    draw(light, clicks, [(mark, mark.exposure_index - first) for mark in marks], scene.what.objects.classes)


def draw(light: np.ndarray, clicks: np.ndarray, marks: list[tuple[Any, int]], classes: tuple[str, ...]) -> None:
    figure, (top, bottom) = pyplot.subplots(
        2, 1, figsize=(9, 5), sharex=True, height_ratios=[3, 1], layout="constrained"
    )
    time_us = (np.arange(len(light)) + 0.5) * EXPOSURE_US
    for channel in range(light.shape[1]):
        top.plot(time_us, light[:, channel], label=f"channel {channel}")
        struck = time_us[clicks[:, channel] > 0]
        bottom.plot(struck, np.full(len(struck), channel), "|", ms=8, mew=1.5)
    for (mark, at), style in zip(marks, ("--", ":")):
        for axes in (top, bottom):
            axes.axvline(at + 0.5, color="k", ls=style, lw=1)
            axes.axvspan(at - mark.half_exposures, at + mark.half_exposures, color="k", alpha=0.06, lw=0)
        words = f"MARK {mark.object_index}: {classes[mark.truth]}\n{mark.photons:.2f} photoelectrons"
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
