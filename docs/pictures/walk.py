"""Draws idea.png, walk.gif, walk.png (its first frame) and automaton.png: a walk of `pans demo`, and where all walks begin. SIMULATED.

python docs/pictures/walk.py       (extras `train` and `plot`; a minute)

The demo runs in virtual time and is recorded. The walk shown is its first decision that is right and surer than 90 %. States and clicks
are those recorded, posteriors the bundle's; photons are what the profile expects of this object.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from PIL import Image

from pans.app.main import main
from pans.app.run import DEMO_DEFAULTS, DEMO_SCENE
from pans.bundle.automaton import Automaton
from pans.bundle.backends import pattern_light
from pans.bundle.sensor import Bundle
from pans.instrument.click_law import object_transmission
from pans.instrument.profile import load_profile
from pans.record.reading import iter_exposures, read_recording, recorded_plan
from pans_sim.scene import Scene, load_scene
from pans_trainer.figures import drawn, save_figure

HERE, WIDTH = Path(__file__).parent, 8.9  # inches: 801 pixels, so that 16 points are 9 pixels high on a phone
SURE = 0.9
STEP_MS, PAUSE_MS, COLOURS = 500, 4000, 64
INK, FAINT, CLICK, RIGHT = "#222222", "#8c8c8c", "#d1495b", "#2a7f62"
DARK, LIT = np.array(to_rgb("#1d2433")), np.array(to_rgb("#ffc233"))


@dataclass(frozen=True)
class Walk:
    """A recorded walk: the object, of each exposure its state, click, photoelectrons expected and light sent, and the posteriors."""

    bundle: Bundle
    machine: Automaton
    number: int  # of the decision, from 1
    scene: Scene
    image: Any
    states: Any
    clicks: Any
    photons: Any
    illumination: Any
    posteriors: Any  # (exposures + 1, classes): before the first exposure and after each

    def pattern(self, state: int) -> Any:
        """The pattern of a state, 0 and 1."""
        return self.bundle.pattern_levels[self.machine.pattern[state]].reshape(self.image.shape)

    def quiet(self, exposure: int) -> bool:
        """Whether nothing happens: no light is sent, and nothing clicks."""
        return not self.illumination[exposure] and not self.clicks[exposure]

    @property
    def decided(self) -> str:
        return f"{self.bundle.classes[self.posteriors[-1].argmax()]}, {self.posteriors[-1].max():.0%}"

    @property
    def spent(self) -> str:
        """What the decision took."""
        clicks, photons, light = (each.sum() for each in (self.clicks, self.photons, self.illumination))
        return f"{clicks} clicks, {photons:.1f} photons expected, illumination {light:.0f}"


def demo_walk() -> Walk:
    """Run the demo and return the walk to be shown."""
    with TemporaryDirectory() as folder:
        main(["demo", "--pace", "fast", "--out", f"{folder}/demo"])
        recording = read_recording(f"{folder}/demo/run.pansrec")
        bundle, decisions = recording.bundle(), recording.decisions()
        seen = list(iter_exposures(recording, recorded_plan(recording)))
    machine, scene, profile = bundle.automaton, load_scene(DEMO_SCENE), load_profile(str(DEMO_DEFAULTS["profile"]))
    assert machine is not None
    right = (decisions["label"] == decisions["truth"]) & (decisions["probability"] > SURE)
    chosen = decisions[right.argmax()]
    state, number, click = (
        np.concatenate([getattr(one, key) for one in seen]) for key in ("state", "number", "clicks")
    )
    here = (number <= chosen["exposure_index"]) & (number > chosen["exposure_index"] - chosen["exposures"])
    states, clicks = state[here].astype(int), click[here, 0]
    leaf = machine.successors[states[-1], int(clicks[-1])]
    image, patterns = scene.images[chosen["object"]], bundle.pattern_levels[machine.pattern[states]]
    assert isinstance(scene, Scene)
    share, scale = machine.dwell[states] / machine.dwell_steps, bundle.photons_per_level
    through = object_transmission(profile, image.reshape(1, -1))
    light = pattern_light(patterns, through, scale)[0] * share
    sent = patterns.sum(axis=1) * scale * share
    posteriors = machine.posteriors[np.append(states, leaf)]
    return Walk(bundle, machine, int(chosen["index"]) + 1, scene, image, states, clicks, light, sent, posteriors)


def canvas(height: float) -> tuple[Figure, Any]:
    """A figure with one empty axes over all of it, in units of inches."""
    figure = Figure(figsize=(WIDTH, height), facecolor="white")
    page = figure.add_axes((0, 0, 1, 1))
    page.set(xlim=(0, WIDTH), ylim=(0, height))
    page.axis("off")
    return figure, page


def lit(behind: Any, light: Any) -> Any:
    """Colours, float (height, width, 3), of an object in the dark, 0 to 1, and the light on it, 0 to 1."""
    grey = DARK + 0.45 * behind[..., None] * (1 - DARK)
    return grey + light[..., None] * (LIT - grey)


def square(page: Any, x: float, y: float, side: float, image: Any, edge: str = INK) -> None:
    """Draw an image, grey or coloured, with its lower left corner at (x, y)."""
    page.imshow(image, "gray", extent=(x, x + side, y, y + side), interpolation="nearest", aspect="auto")
    page.add_patch(Rectangle((x, y), side, side, fill=False, ec=edge, lw=1.5))
    page.set(xlim=(0, WIDTH), ylim=(0, page.figure.get_figheight()))


def words(page: Any, x: float, y: float, text: str, size: float = 16, **more: Any) -> None:
    page.text(x, y, text, fontsize=size, **({"color": INK, "ha": "center", "va": "center"} | more))


def arrow(page: Any, begin: tuple[float, float], end: tuple[float, float], **more: Any) -> None:
    style = {"arrowstyle": "-|>", "mutation_scale": 24, "lw": 2.5, "color": FAINT}
    page.add_patch(FancyArrowPatch(begin, end, **(style | more)))


def slots(page: Any, walk: Walk, done: int, x: float, y: float, step: float, columns: int) -> None:
    """Draw a cell for each exposure: a dot where a click came, empty where none did, pale where it is still to come."""
    for k, click in enumerate(walk.clicks):
        at = (x + step * (k % columns), y - step * (k // columns))
        page.add_patch(Rectangle(at, 0.84 * step, 0.84 * step, fc="white", ec=INK if k < done else "#d0d0d0", lw=1.2))
        if k < done and click:
            page.add_patch(Rectangle(at, 0.84 * step, 0.84 * step, fc=CLICK, ec=CLICK))


def idea(walk: Walk) -> Figure:
    """Patterns, object, clicks, decision, in one row; each click chooses the next pattern."""
    figure, page = canvas(3.9)
    side, y = 1.5, 1.4
    lightest = np.sort(np.argsort(-walk.photons)[:4])
    for k, state in enumerate(walk.states[lightest]):
        at = (0.12 + 0.99 * (k % 2), y + 0.81 - 0.99 * (k // 2))
        square(page, *at, 0.94, lit(0 * walk.image, walk.pattern(state)))
    square(page, 2.62, y, side, walk.image)
    slots(page, walk, len(walk.clicks), 4.73, y + 1.27, 0.23, 8)
    words(page, 5.63, y + 0.32, "one detector", 15)
    for x, name in ((1.09, "patterns"), (3.37, "object"), (5.63, "clicks"), (7.83, "decision")):
        words(page, x, 3.55, name, 19, weight="bold")
    for k, label in enumerate(np.argsort(-walk.posteriors[-1])[:3]):
        chance, at = walk.posteriors[-1][label], y + 1.22 - 0.56 * k
        page.add_patch(Rectangle((7.03, at - 0.28), 1.7 * chance, 0.15, fc=RIGHT if not k else FAINT))
        words(page, 7.03, at + 0.06, f"{walk.bundle.classes[label]} {chance:.0%}", 15, ha="left")
    for begin, end in ((2.08, 2.55), (4.17, 4.65), (6.6, 6.98)):
        arrow(page, (begin, y + side / 2), (end, y + side / 2))
    arrow(page, (5.63, y - 0.22), (1.09, y - 0.22), connectionstyle="arc3,rad=-0.12", color=CLICK)
    words(page, 3.36, 0.62, "each click chooses the next pattern", 17, color=CLICK)
    words(page, WIDTH / 2, 0.2, f"SIMULATED: {walk.spent}", 15)
    return figure


def frame(walk: Walk, done: int) -> Figure:
    """The walk after `done` exposures: pattern, click, posterior, and the clicks so far; the last one has the light of all."""
    figure, page = canvas(5.5)
    ends, last = done == len(walk.clicks), done - 1
    light = walk.pattern(walk.states[last])
    if ends:
        sent = np.add.reduce([walk.pattern(state) for state in walk.states])
        light = sent / sent.max()
    square(page, 0.2, 2.75, 1.95, walk.image)
    square(page, 2.3, 2.75, 1.95, lit(walk.image / 255, light))
    words(page, 1.17, 5.0, "object", 19, weight="bold")
    words(page, 3.27, 5.0, "all patterns" if ends else f"pattern {done}", 19, weight="bold")
    words(page, 4.75, 5.0, "chance of each class", 19, ha="left", weight="bold")
    clicked, dark = bool(walk.clicks[last]), not walk.illumination[last]
    so_far = f"{walk.clicks[:done].sum()} of {done} clicked"
    if ends:
        words(page, 0.2, 2.42, "decided:", 17, ha="left")
        words(page, 0.2, 1.95, walk.decided, 22, ha="left", color=RIGHT, weight="bold")
    else:
        expected = "no light is sent" if dark else f"{walk.photons[last]:.2f} photons expected"
        outcome = ("a dark count" if dark else "a click") if clicked else "no click"
        words(page, 0.2, 2.42, expected, 17, ha="left")
        words(page, 0.2, 1.95, outcome, 22, ha="left", color=CLICK if clicked else FAINT, weight="bold")
    now = walk.posteriors[done]
    for label, name in enumerate(walk.bundle.classes):
        y, leads = 4.57 - 0.31 * label, label == now.argmax()
        colour = (RIGHT if ends else INK) if leads else FAINT
        style = {"color": colour, "weight": "bold" if leads else "normal"}
        words(page, 6.3, y, name, 16, ha="right", **style)
        page.add_patch(Rectangle((6.4, y - 0.11), 1.65 * now[label], 0.22, fc=colour))
        if leads:
            words(page, 6.48 + 1.65 * now[label], y, f"{now[label]:.0%}", 16, ha="left", **style)
    slots(page, walk, done, 0.2, 1.1, 0.266, 32)
    words(page, 0.2, 0.72, walk.spent if ends else so_far, 16, ha="left")
    words(page, 0.2, 0.27, f"SIMULATED: decision {walk.number} of pans demo", 15, ha="left", color="#555555")
    return figure


def animate(walk: Walk, path: Path) -> None:
    """Write the walk as a GIF that begins, and so ends, with the decision, and the decision alone as a PNG.

    Of exposures in a row in which nothing happens, the last one is shown.
    """
    total = len(walk.clicks)
    steps = [done for done in range(1, total) if not (walk.quiet(done - 1) and walk.quiet(done))]
    pictures = [drawn(frame(walk, done)) for done in (total, *steps)]
    every = Image.fromarray(np.concatenate([np.asarray(picture) for picture in pictures]))
    palette = every.quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    shown = [picture.quantize(palette=palette, dither=0) for picture in pictures]
    times = [PAUSE_MS] + [STEP_MS] * len(steps)
    shown[0].save(path, save_all=True, append_images=shown[1:], duration=times, loop=0, optimize=True)
    shown[0].save(path.with_suffix(".png"), optimize=True)


def beginnings(walk: Walk) -> Figure:
    """The first three exposures of all walks: a tree of patterns on the objects that come there, and the leading class behind each."""
    figure, page = canvas(6.2)
    means = np.stack([walk.scene.images[walk.scene.labels == label].mean(axis=0) for label in range(10)]) / 255
    level: list[int] = [0]
    side, heights = 1.35, (4.75, 2.83, 0.91)
    for depth, y in enumerate(heights):
        across = WIDTH / len(level)
        for k, state in enumerate(level):
            x, pattern = across * (k + 0.5), walk.pattern(state)
            square(page, x - side / 2, y, side, lit(np.tensordot(walk.machine.posteriors[state], means, 1), pattern))
            if not pattern.any():
                words(page, x, y + 0.16, "no light", 13, color="white")
            for outcome, after in enumerate(walk.machine.successors[state]):
                where = 2 * outcome - 1
                target = x + across / 4 * where, heights[depth + 1] + side if depth < 2 else 0.62
                colour = CLICK if outcome else FAINT
                arrow(page, (x + side / 4 * where, y - 0.03), target, mutation_scale=14, lw=2, color=colour)
                if depth == 2:
                    chances = walk.machine.posteriors[after]
                    words(page, target[0], 0.32, f"{walk.bundle.classes[chances.argmax()]}\n{chances.max():.0%}", 14)
        level = [int(after) for state in level for after in walk.machine.successors[state]]
    words(page, 2.3, 5.1, "no click", 18, color=FAINT, weight="bold")
    words(page, 6.5, 5.1, "click", 18, color=CLICK, weight="bold")
    return figure


if __name__ == "__main__":
    found = demo_walk()
    print(f"decision {found.number}: {found.decided}; {found.spent}")
    save_figure(idea(found), HERE / "idea.png")
    save_figure(beginnings(found), HERE / "automaton.png")
    animate(found, HERE / "walk.gif")
