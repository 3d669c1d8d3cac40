"""Every page of results: those of the paper, of the frontier and of single questions, by their names."""

from __future__ import annotations

from pans.trainer import frontier, paper, studies
from pans.trainer.paper.page import Page

PAGES = (*paper.PAGES, *frontier.NAMES, *studies.PAGES)


def page_of(name: str) -> Page:
    """Return the page of that name; KeyError for another name."""
    if name in studies.PAGES:
        return studies.page_of(name)
    return frontier.PAGES[name] if name in frontier.NAMES else paper.page_of(name)
