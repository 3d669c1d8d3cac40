"""The paper's tables and figures beside ours.

Owns the pages of `pans reproduce`: for each a recipe, what measures its rows, the tables made of them, and its pictures. A page's rows
are plain JSON, its tables are made of them alone, and the prose about them is written by hand in docs/results. Finished parts of long
work lie in a cache folder. Never touches a device; data sets are read by the package `tasks`.

A new page is a function that measures, one that makes tables, a title and columns in pages.toml, and a line in `PAGES`.
"""

from __future__ import annotations

import importlib

from .page import Asked, Made, Page, rewrite_page, write_page

__all__ = ["PAGES", "Asked", "Made", "Page", "page_of", "rewrite_page", "write_page"]

PAGES = {  # name of a page: the module whose PAGES holds it, imported when it is asked for
    **dict.fromkeys(("fashion-mnist", "mnist"), "active"),
    **dict.fromkeys(("barcode", "cells", "mmf-mnist", "mmf-mnist-image", "transient", "fiber"), "passive"),
    **dict.fromkeys(("tissue", "nebula", "cells-4"), "passive"),
    **dict.fromkeys(("estimators", "time"), "training"),
    "equal-photons": "equal",
    "sweeps": "swept",
    "fig-2c": "information",
    **dict.fromkeys(("confusion", "dark-counts", "eta"), "swept"),
    **dict.fromkeys(("fig-3", "multi-shot"), "shots"),
    "single-shot": "readouts",
    **dict.fromkeys(("alpha", "evolution"), "alpha"),
    **dict.fromkeys(("fig-2e", "end-to-end", "compressive"), "paradigms"),
    "direct-frames": "readouts",
}


def page_of(name: str) -> Page:
    """Return the page of that name; KeyError for a name that is not in `PAGES`."""
    page: Page = importlib.import_module(f".{PAGES[name]}", __package__).PAGES[name]
    return page
