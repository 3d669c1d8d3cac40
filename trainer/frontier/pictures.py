"""Pictures that explain an automaton: its first levels as a tree, single walks, where its light goes, and what is known when.

Owns what is drawn and how; the numbers are those of explained.py. One PNG file each.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.trainer.figures import new_figure, save_figure, use_files_alone
from pans.trainer.tasks.registry import Task

from .explained import Explained, Walk, automaton_of, explain, sample_walk, state_light

OBJECTS = 2000  # test objects that the means are taken over
TREE_LEVELS = 4
ACROSS = 16  # exposures of a walk in one line
SHOES_AND_SHIRTS = (
    ("Sneaker", "Ankle boot", "Sandal"),
    ("Shirt", "T-shirt/top"),
)  # the first class of each that the task has


@dataclass(frozen=True, slots=True, eq=False)
class ShownAutomaton:
    """A bundle, what it does on the first test objects, and a walk each of a few objects."""

    bundle: Bundle
    explained: Explained
    objects: int
    walks: list[tuple[str, NDArray[np.uint8], Walk]]

    @property
    def title(self) -> str:
        """What the pictures are of."""
        facts = self.bundle.expected or {}
        words = f"{self.bundle.task}, automaton of {automaton_of(self.bundle).n_states} states"
        return f"{words}, {facts['accuracy']:.1%} at {facts['photons']:.1f} photons" if facts else words


def shown_automaton(path: Path, task: Task) -> ShownAutomaton:
    """Read the bundle at `path` and walk it over the first test objects of `task`, and through one shoe and one shirt (or two objects)."""
    bundle, _ = load_bundle(path)
    flat = task.test.images.reshape(len(task.test), -1)
    found = explain(bundle, flat[:OBJECTS] / 255)
    rng = np.random.default_rng(0)
    walks: list[tuple[str, NDArray[np.uint8], Walk]] = []
    for names in SHOES_AND_SHIRTS:
        label = next(
            (task.classes.index(name) for name in names if name in task.classes), len(walks) % len(task.classes)
        )
        which = int(np.flatnonzero(task.test.labels == label)[0])
        walks.append((task.classes[label], task.test.images[which], sample_walk(bundle, flat[which] / 255, rng)))
    return ShownAutomaton(bundle, found, min(OBJECTS, len(flat)), walks)


# ---- the first levels ----


def tree(path: Path, shown: ShownAutomaton) -> None:
    """Draw the patterns of the first levels: left after no click, right after a click; with the chance of a click and of coming there."""
    use_files_alone()
    from matplotlib import pyplot

    automaton = automaton_of(shown.bundle)
    light = state_light(shown.bundle)
    figure = pyplot.figure(figsize=(13, 7.6))
    whole = figure.add_axes((0, 0, 1, 1))
    whole.set(xlim=(0, 1), ylim=(0, 1))
    whole.set_axis_off()
    levels: list[list[int]] = [[0]]
    for _ in range(min(TREE_LEVELS, automaton.n_slots) - 1):
        levels.append([after for node in levels[-1] for after in _after(automaton, node)])
    for level, nodes in enumerate(levels):
        for place, node in enumerate(nodes):
            x, y = (place + 0.5) / len(nodes), 0.86 - 0.225 * level
            if node < 0:
                continue
            if level:
                up = ((place // 2 + 0.5) / len(levels[level - 1]), y + 0.225 - 0.083)
                clicked = place % 2 == 1
                whole.plot([up[0], x], [up[1], y + 0.085], color="C3" if clicked else "C0", lw=1.2)
                words = "click" if clicked else "no click"
                whole.text(
                    (up[0] + x) / 2 + (0.006 if clicked else -0.006),
                    (up[1] + y + 0.085) / 2,
                    words,
                    fontsize=7,
                    color="C3" if clicked else "C0",
                    ha="left" if clicked else "right",
                )
            _node(figure, whole, shown, light, node, x, y)
    words = "first exposures, above each what is known before it"
    figure.suptitle(f"{shown.title}; {words} (SIMULATED)", fontsize=10, y=0.985)
    save_figure(figure, path)


def _after(automaton: Any, node: int) -> tuple[int, int]:
    ended = node < 0 or node >= automaton.n_states
    return (-1, -1) if ended else (int(automaton.successors[node, 0]), int(automaton.successors[node, 1]))


def _node(
    figure: Any, whole: Any, shown: ShownAutomaton, light: NDArray[np.float64], node: int, x: float, y: float
) -> None:
    automaton, found = automaton_of(shown.bundle), shown.explained
    side = 0.115
    best = int(automaton.posteriors[node].argmax())
    known = f"{shown.bundle.classes[best]} {automaton.posteriors[node][best]:.0%}"
    if node >= automaton.n_states:
        whole.text(x, y, f"decides:\n{known}", ha="center", va="center", fontsize=8)
        return
    axis = figure.add_axes((x - side * 0.58 / 2, y - side / 2, side * 0.58, side))
    axis.imshow(light[node].reshape(shown.bundle.image_shape), cmap="inferno", vmin=0)
    axis.set(xticks=[], yticks=[])
    mean = found.reach[node]
    whole.text(x, y + side / 2 + 0.004, known, ha="center", va="bottom", fontsize=7)
    whole.text(
        x,
        y - side / 2 - 0.006,
        f"P(here) {mean:.2f}, P(click) {found.click[node]:.2f}",
        ha="center",
        va="top",
        fontsize=7,
    )


# ---- single walks ----


def walks(path: Path, shown: ShownAutomaton) -> None:
    """Draw every pattern of a walk of each object, clicks framed, and the posterior below."""
    use_files_alone()
    from matplotlib import pyplot

    light = state_light(shown.bundle)
    lines = [-(-len(walk.states) // ACROSS) for _, _, walk in shown.walks]
    figure = pyplot.figure(figsize=(14, 1.05 * sum(lines) + 2.7 * len(lines) + 0.8), layout="constrained")
    parts = figure.subfigures(len(lines), 1, squeeze=False, height_ratios=[1.05 * n + 2.7 for n in lines])
    for part, n, (name, image, walk) in zip(parts[:, 0], lines, shown.walks):
        _walk(part, n, shown, light, name, image, walk)
    figure.suptitle(f"{shown.title}; one sampled walk each, exposures with a click framed red (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def _walk(
    part: Any, n_lines: int, shown: ShownAutomaton, light: NDArray[np.float64], name: str, image: Any, walk: Walk
) -> None:
    grid = part.add_gridspec(n_lines + 1, ACROSS + 1, height_ratios=[1.0] * n_lines + [2.2])
    first = part.add_subplot(grid[0, 0])
    first.imshow(image, cmap="gray", vmin=0, vmax=255)
    first.set(xticks=[], yticks=[])
    first.set_title(name, fontsize=8)
    for k, (state, clicked) in enumerate(zip(walk.states, walk.clicks)):
        axis = part.add_subplot(grid[k // ACROSS, 1 + k % ACROSS])
        axis.imshow(light[state].reshape(shown.bundle.image_shape), cmap="inferno", vmin=0)
        axis.set(xticks=[], yticks=[])
        axis.set_title(f"{k + 1}: {walk.expected[k]:.2f}", fontsize=6.5, pad=2)
        for spine in axis.spines.values():
            spine.set(color="red" if clicked else "0.6", linewidth=2.6 if clicked else 0.6)
    below = part.add_subplot(grid[n_lines, :])
    automaton = automaton_of(shown.bundle)
    known = automaton.posteriors[walk.nodes]
    below.stackplot(
        np.arange(len(known)),
        known.T,
        labels=shown.bundle.classes,
        colors=[f"C{i}" for i in range(known.shape[1])],
        alpha=0.8,
    )
    for clicked_at in np.flatnonzero(walk.clicks).tolist():
        below.axvline(clicked_at + 1, color="red", lw=0.9, ls=":")
    decided = shown.bundle.classes[int(known[-1].argmax())]
    light_of_walk = f"{int(walk.clicks.sum())} clicks, {walk.expected.sum():.1f} photons expected"
    below.set_title(
        f"above each pattern: exposure and its expected photons; posterior below: {decided}, {known[-1].max():.0%} ({light_of_walk})",
        fontsize=8,
    )
    below.set(xlim=(0, len(known) - 1), ylim=(0, 1), xlabel="exposures made (dotted: a click)", ylabel="posterior")
    below.xaxis.get_major_locator().set_params(integer=True)
    below.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))


# ---- means ----


def light(path: Path, shown: ShownAutomaton) -> None:
    """Draw photons and clicks by exposure, and the light that each pixel is sent over a decision."""
    found = shown.explained
    figure, (left, right) = new_figure(width=12.0, height=4.2)
    slots = np.arange(1, len(found.photons) + 1)
    left.bar(slots, found.photons, color="C1", label=f"photons detected ({found.photons.sum():.2f} in all)")
    left.step(slots, found.clicks, where="mid", color="C3", lw=1.5, label=f"clicks ({found.clicks.sum():.2f} in all)")
    left.plot(
        slots, found.lit * found.photons.max(), color="0.5", ls="--", lw=1, label="walks that still go on (top: all)"
    )
    left.set(xlabel="exposure", ylabel="mean per decision", xlim=(0.3, len(slots) + 0.7))
    left.xaxis.get_major_locator().set_params(integer=True)
    left.grid(alpha=0.3)
    left.legend(fontsize=8)
    drawn = right.imshow(found.pixel_light.reshape(shown.bundle.image_shape), cmap="inferno", vmin=0)
    right.set(xticks=[], yticks=[], title="light sent to each pixel over a decision")
    figure.colorbar(drawn, ax=right, label="photoelectrons at transmission 1")
    figure.suptitle(f"{shown.title}; mean of {shown.objects} test images (SIMULATED)", fontsize=10)
    save_figure(figure, path)


def entropy(path: Path, shown: ShownAutomaton) -> None:
    """Draw the entropy of the posterior against exposures made and against photons spent."""
    found = shown.explained
    figure, (left, right) = new_figure(width=11.0, height=4.2)
    mean, low, high = found.entropy.T
    made, spent = np.arange(len(mean)), np.concatenate([[0.0], np.cumsum(found.photons)])
    for axis, x, label in ((left, made, "exposures made"), (right, spent, "photons detected so far, mean")):
        axis.fill_between(x, low, high, color="C0", alpha=0.2, lw=0, label="lowest to highest tenth of the walks")
        axis.plot(x, mean, color="C0", label="mean")
        axis.axhline(np.log2(len(shown.bundle.classes)), color="0.5", lw=0.8, ls=":")
        axis.set(xlabel=label, ylabel="entropy of the posterior, bits", xlim=(0, x[-1]), ylim=(0, None))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, loc="upper right")
    left.xaxis.get_major_locator().set_params(integer=True)
    figure.suptitle(f"{shown.title}; {shown.objects} test images, dotted: nothing known (SIMULATED)", fontsize=10)
    save_figure(figure, path)
