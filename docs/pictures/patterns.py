"""Draws docs/pictures/patterns.png: the ten trained patterns of `fashion10`, and how often each class clicks under each. SIMULATED.

python docs/pictures/patterns.py       (extras `train` and `plot`)

Exact chances on the bundle's profile, means over the objects of the shipped scene.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from walk import lit

from pans.app.run import DEMO_SCENE
from pans.bundle.sensor import load_bundle
from pans.instrument.profile import load_profile
from pans_sim.scene import load_scene
from pans_trainer.evaluate.accuracy import light_of
from pans_trainer.figures import new_figure, save_figure


def main() -> None:
    """Draw the patterns above the columns of a table of chances."""
    bundle, scene = load_bundle("fashion10")[0], load_scene(DEMO_SCENE)
    profile = load_profile(str(bundle.provenance["profile"]))
    chance = light_of(bundle, profile, scene.images).probability
    means = np.stack([chance[scene.labels == label].mean(axis=0) for label in range(len(scene.classes))])
    behind = scene.images.mean(axis=0) / 255
    figure, axis = new_figure(8.9, 5.2, panels=1)
    axis.imshow(means, "Blues", vmin=0, vmax=1, aspect="auto")
    for (label, pattern), value in np.ndenumerate(means):
        colour = "white" if value > 0.5 else "#222222"
        axis.text(pattern, label, f"{100 * value:.0f}", ha="center", va="center", fontsize=14, color=colour)
    for number, pattern in enumerate(bundle.pattern_levels):
        above = axis.inset_axes((0.1 * number + 0.003, 1.02, 0.094, 0.2))
        light = np.sqrt(pattern.reshape(behind.shape) / pattern.max())  # faint light is seen as well
        above.imshow(lit(behind, light))
        above.set(xticks=(), yticks=(), anchor="S")
    axis.set_yticks(range(len(scene.classes)), scene.classes, fontsize=15)
    axis.set_xticks(())
    axis.set_xlabel("clicks in 100 exposures, mean of a class", fontsize=16)
    figure.suptitle("SIMULATED: ten trained patterns", fontsize=16)
    save_figure(figure, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()
