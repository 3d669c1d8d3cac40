"""A folder of results, checked: text, JSON and command of every page agree.

Owns what is looked at and the findings; changes nothing. A fault is a contradiction. A note names a page whose rows come from different
versions, as far as its JSON tells (versions.py).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pans.trainer.paper.page import BEGIN, END, Page, Rows, generated

from .commands import command_faults
from .declared import faults
from .index import INDEX, index_counts
from .known import PAGES, page_of
from .sources import Figures
from .versions import version_notes

PNG = b"\x89PNG\r\n\x1a\n"
_LINK = re.compile(r"\]\(([^)#:]+\.(?:png|md))(?:#[^)]*)?\)")
_SEED = re.compile(r"one per (?:row|d_f), seed (\d+)")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found: the page, what of it (table, number, command, picture, training, count, version), and the words."""

    page: str
    kind: str
    words: str


def check_folder(folder: Path) -> tuple[list[Finding], list[Finding]]:
    """Return the faults and the notes of all pages of results in `folder`."""
    figures, found = Figures(folder), []
    for name in PAGES:
        if (folder / f"{name}.json").is_file() and (folder / f"{name}.md").is_file():
            found += _of_page(figures, name)
        else:
            found.append(Finding(name, "missing", f"{name}.json and {name}.md are not both in {folder}"))
    others = sorted(path.stem for path in folder.glob("*.md") if path.stem not in PAGES)
    for name in others:
        found += [Finding(name, kind, words) for kind, words in _of_text(figures, name)]
    if (folder / INDEX).is_file() and index_counts(folder) not in (folder / INDEX).read_text(encoding="utf-8"):
        found.append(Finding("README", "count", f"the counts are not those of the pages: {_AGAIN}"))
    return found, [Finding(name, "version", words) for name in PAGES for words in version_notes(figures, name)]


_AGAIN = "pans reproduce all --from-json -o FOLDER writes tables and counts again"


def _of_page(figures: Figures, name: str) -> list[Finding]:
    page, folder = page_of(name), figures.folder
    text = (folder / f"{name}.md").read_text(encoding="utf-8")
    found = [(kind, words) for kind, words in _of_text(figures, name)]
    if not text.startswith(f"# {page.title}\n"):
        found.append(("title", f"the first line is not # {page.title}"))
    if generated(folder, name, page) not in text:
        found.append(("table", f"what stands between the markers is not what {name}.json gives: {_AGAIN}"))
    by_hand = text.partition(BEGIN)[0] + text.partition(END)[2]
    if "\n| " in by_hand:
        found.append(("table", "a table outside the markers: no JSON stands behind it"))
    found += [("training", words) for words in _trainings(page, figures.rows(name))]
    return [Finding(name, kind, words) for kind, words in found]


def _of_text(figures: Figures, name: str) -> Iterator[tuple[str, str]]:
    """What any page's text can be checked for: its numbers, its commands, and what it links to."""
    text = (figures.folder / f"{name}.md").read_text(encoding="utf-8")
    yield from (("number", words) for words in faults(figures, name))
    yield from (("command", words) for words in command_faults(text))
    for target in dict.fromkeys(_LINK.findall(text)):
        path = figures.folder / target
        if target.endswith(".png") and not (path.is_file() and path.read_bytes().startswith(PNG)):
            yield "picture", f"{target} is not there, or no PNG file"
        elif "/" not in target and not path.is_file():
            yield "link", f"{target} is not there"


def _trainings(page: Page, rows: Rows) -> Iterator[str]:
    """The number of trainings that a page states, against the seeds in its JSON, where it has them."""
    said = _SEED.match(page.trainings)
    seeds = sorted({row["options"]["seed"] for row in rows if "options" in row})
    if said and seeds and seeds != [int(said[1])]:
        yield f'its head says "{page.trainings}", its rows have the seeds {seeds}'
