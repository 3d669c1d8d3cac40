"""Scenes whose light is their own (paper, Fig. 5E to H): the cells of passive.py beside direct imaging, whose ways are in ways.toml."""

from __future__ import annotations

from .page import Asked, Made, Rows, of_table
from .passive import beside_camera, passive_page
from .ways import best_of, measured_points

CAMERA = "direct, best of these"


def scene_page(asked: Asked) -> Made:
    """Return the cells beside a camera, then the camera; with `asked.ways` the cells are those of the page as it is."""
    direct = camera_rows(asked)
    made = passive_page(asked) if asked.ways is None else Made(of_table([*asked.known], asked.name))
    best = [row for row in direct if row["way"] == CAMERA]
    return Made([row | beside_camera(row, best) for row in made.rows] + direct, made.pictures)


def camera_rows(asked: Asked) -> Rows:
    """Return direct imaging, a row per way and level, and the best of them at each level."""
    rows = [row | {"table": "direct"} for row in measured_points(asked, asked.name)]
    return rows + best_of(rows, CAMERA)
