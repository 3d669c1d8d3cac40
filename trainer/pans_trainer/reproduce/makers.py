"""The function that measures each page of results, by its name in pages.toml."""

from __future__ import annotations

from collections.abc import Callable

from . import active, curves, passive, readouts, scenes, sequence, trained
from .page import Asked, Made, Page

MAKERS: dict[str, Callable[[Asked], Made]] = {
    "active_page": active.active_page,
    "alpha_page": curves.alpha_page,
    "compressive_page": curves.compressive_page,
    "end_to_end_page": curves.end_to_end_page,
    "evolution_page": curves.evolution_page,
    "fig_2e_page": curves.fig_2e_page,
    "frontier_page": curves.frontier_page,
    "field_page": passive.field_page,
    "passive_page": passive.passive_page,
    "bound_page": readouts.bound_page,
    "frames_page": readouts.frames_page,
    "information_page": readouts.information_page,
    "maps_page": readouts.maps_page,
    "scene_page": scenes.scene_page,
    "sequence_page": sequence.sequence_page,
    "confusion_page": trained.confusion_page,
    "fig_3_page": trained.fig_3_page,
    "multi_shot_page": trained.multi_shot_page,
    "single_shot_page": trained.single_shot_page,
    "swept_page": trained.swept_page,
}


def measure(page: Page, asked: Asked) -> Made:
    """Measure a page, or collect the parts that are finished."""
    return MAKERS[page.make](asked)
