"""The first steps of an automaton's walks as a drawing: patterns at the places of their states, with the ways between them.

Levels go from the top down on a wide page and on a narrow one; on the latter fewer of them are drawn.
"""

from __future__ import annotations

import base64
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .patterns import grey_png

LEVEL_PX, GAP_PX, TEXT_PX = 150, 10, 34
PICTURE_MAX_PX, PICTURE_LEAST_PX = 92, 64


class TreeNode(NamedTuple):
    """A state of the tree: its level, which share of the walks came there, clicks per exposure, and the places of its two successors.

    A place is -1 where the successor is not drawn.
    """

    state: int
    level: int
    share: float
    rate: float
    leads: tuple[int, ...]


class Tree:
    """Draws `nodes` with their patterns (n, height, width)."""

    def __init__(self, nodes: list[TreeNode], pictures: NDArray[np.float64]) -> None:
        self._nodes = nodes
        self._sources = [
            base64.b64encode(grey_png(picture, 0.0, float(picture.max()) or 1.0)).decode() for picture in pictures
        ]

    def svg(self, width: int) -> str:
        """Return the drawing `width` pixels wide, with as many levels as have room."""
        counts = np.bincount([node.level for node in self._nodes])
        fits = [level for level, count in enumerate(counts) if count * (PICTURE_LEAST_PX + GAP_PX) <= width]
        levels = next((level for level in range(len(counts)) if level not in fits), len(counts))
        shown = [number for number, node in enumerate(self._nodes) if node.level < levels]
        size = min(PICTURE_MAX_PX, width / max(counts[:levels]) - GAP_PX)
        where = places([self._nodes[number] for number in shown], levels)
        height = levels * LEVEL_PX
        parts = [self._ways(number, where, width, size) for number in shown]
        parts += [self._state(number, where[number], width, size) for number in shown]
        label = f"The first {levels} steps of the walks as a tree of patterns"
        return (
            f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" aria-label="{label}">'
            f"{''.join(parts)}</svg>"
        )

    def _ways(self, number: int, where: list[tuple[float, float]], width: int, size: float) -> str:
        x, y = where[number]
        lines = []
        for click, lead in enumerate(self._nodes[number].leads):
            if 0 <= lead < len(where):
                to = where[lead]
                ends = f'x1="{x * width:.1f}" y1="{y * LEVEL_PX + size + TEXT_PX:.1f}" x2="{to[0] * width:.1f}" y2="{to[1] * LEVEL_PX:.1f}"'
                lines.append(f'<line class="{"click" if click else "silent"}" {ends}/>')
        return "".join(lines)

    def _state(self, number: int, place: tuple[float, float], width: int, size: float) -> str:
        node, (x, y) = self._nodes[number], (place[0] * width, place[1] * LEVEL_PX)
        rate = "never" if np.isnan(node.rate) else f"{100 * node.rate:.0f} % click"
        image = f'x="{x - size / 2:.1f}" y="{y:.1f}" width="{size:.1f}" height="{size:.1f}"'
        return (
            f'<image class="pixels" {image} href="data:image/png;base64,{self._sources[number]}"/>'
            f'<text x="{x:.1f}" y="{y + size + 13:.1f}" text-anchor="middle">{100 * node.share:.0f} %</text>'
            f'<text x="{x:.1f}" y="{y + size + 27:.1f}" text-anchor="middle">{rate}</text>'
        )


def places(nodes: list[TreeNode], levels: int) -> list[tuple[float, float]]:
    """Return the middle (share of the width) and the level of each state; one stands below the middle of those that lead to it."""
    wanted: dict[int, list[float]] = {0: [0.5]}
    where: dict[int, tuple[float, float]] = {}
    for level in range(levels):
        here = sorted(
            (number for number, node in enumerate(nodes) if node.level == level),
            key=lambda at: float(np.mean(wanted.get(at, [0.5]))),
        )
        for side, number in enumerate(here):
            x = (side + 0.5) / len(here)
            where[number] = (x, level)
            for click, lead in enumerate(nodes[number].leads):
                wanted.setdefault(lead, []).append(x + (click - 0.5) * 1e-3)
    return [where[number] for number in range(len(nodes))]
