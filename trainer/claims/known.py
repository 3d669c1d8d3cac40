"""Every page of results: those of the paper and those of the frontier, by their names."""

from __future__ import annotations

from pans.trainer import frontier, paper
from pans.trainer.paper.page import Page

PAGES = (*paper.PAGES, *frontier.NAMES)


def page_of(name: str) -> Page:
    """Return the page of that name, of the paper or of the frontier; KeyError for another name."""
    return frontier.PAGES[name] if name in frontier.NAMES else paper.page_of(name)
