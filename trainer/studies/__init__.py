"""Single questions that the paper raises, each a page of `pans reproduce`.

Owns what lies beside the packages `paper` and `frontier`: which options of a training matter (`ablations`), clicks and decisions while
cells pass (`sequence`, Fig. 4C), single shots mapped beside camera frames of the same photons (`fig-2f`), heads for few labelled
objects (`few-labels`), and digits behind a fibre as a field (`mmf-mnist-field`, Fig. 5B). Rows are plain JSON, parts lie in the cache
folder; the text is written by hand. SIMULATED.
"""

from __future__ import annotations

import importlib

from pans.trainer.paper.page import Page

__all__ = ["PAGES", "page_of"]

PAGES = {  # name of a page: its module, imported when it is asked for
    "ablations": "ablations",
    "few-labels": "few_labels",
    "fig-2f": "fig_2f",
    "mmf-mnist-field": "fibre_field",
    "sequence": "sequence",
}


def page_of(name: str) -> Page:
    """Return the page of that name; KeyError for a name that is not in `PAGES`."""
    page: Page = importlib.import_module(f".{PAGES[name]}", __package__).PAGES[name]
    return page
