"""The numbers of a page's text against what NAME.numbers.toml beside it declares them to be.

Owns the form of that file and the comparison. Of each block of the text that holds numbers it has one entry:

    [[block]]
    begins = "At equal photons"                      # the first words of the block
    from = ['"4:PANS %"', 'max("ahead")']            # the page's figures (sources.py)
    paper = "15 20"                                  # numbers of the paper
    said = { "held-back images, not kept" = "68.6" } # any other constant: where it comes from, and the numbers

Every number of the block must be one of these, rounded as written. A number that stands behind a label (d_f = 10) may also be one of the
page's columns of that label. What is declared and not in the text is a fault too: it says nothing of the text any more.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .prose import NUMBER, WORDS, Block, Number, blocks
from .sources import Figures, Values, Wrong

HELP = "CONTRIBUTING.md, Numbers in pages of results"
NEAR_MOST = 3


@dataclass(frozen=True, slots=True)
class Entry:
    """What is declared of one block."""

    begins: str
    sources: tuple[str, ...]
    constants: tuple[str, ...]  # as written, thousands together


def declared_file(folder: Path, name: str) -> Path:
    """Return where the declarations of a page lie."""
    return folder / f"{name}.numbers.toml"


def read_entries(path: Path) -> list[Entry]:
    """Return the entries of a file; `Wrong` for one that is malformed, or whose constants are no numbers."""
    try:
        facts = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise Wrong(f"{path.name}: {error}") from error
    found = facts.get("block", [])
    if not isinstance(found, list) or set(facts) - {"block"}:
        raise Wrong(f"{path.name}: [[block]] is wanted, and nothing else; found {sorted(facts)}")
    return [_entry(path, one) for one in found]


def _entry(path: Path, one: Any) -> Entry:
    said, paper = one.get("said", {}), one.get("paper", "")
    sources = one.get("from", [])
    texts = [one.get("begins"), paper, *sources, *said, *said.values()]
    if set(one) - {"begins", "from", "paper", "said"} or not all(isinstance(text, str) for text in texts):
        raise Wrong(f"{path.name}: {one}: begins, from, paper and said are wanted, as {HELP} shows them")
    constants = [word for text in (paper, *said.values()) for word in text.split()]
    for word in constants:
        if not (NUMBER.fullmatch(word) or word.lower() in WORDS):
            raise Wrong(f'{path.name}: "{one["begins"]}": {word} is no number (write 10 000 as 10000)')
    return Entry(one["begins"], tuple(sources), tuple(constants))


def faults(figures: Figures, name: str) -> list[str]:
    """Return what is wrong with the numbers in the text of NAME.md, each with its sentence, what is near, and what to do."""
    path = declared_file(figures.folder, name)
    try:
        entries = read_entries(path)
    except Wrong as wrong:
        return [str(wrong)]
    text = (figures.folder / f"{name}.md").read_text(encoding="utf-8")
    found: list[str] = []
    left = list(entries)
    for block in blocks(text):
        mine = [entry for entry in left if block.text.startswith(entry.begins)][:1]
        for entry in mine:
            left.remove(entry)
        found += _block_faults(figures, name, block, mine[0] if mine else Entry("", (), ()))
    return found + [
        f'{path.name}: no block with numbers begins with "{entry.begins}": correct or remove it' for entry in left
    ]


def _block_faults(figures: Figures, name: str, block: Block, entry: Entry) -> Iterator[str]:
    pools: dict[str, Values] = {}
    for source in entry.sources:
        try:
            pools[source] = figures.values(name, source)
        except Wrong as wrong:
            yield f'{name}.numbers.toml: "{entry.begins}": {wrong}'
    used: set[str] = set()
    undeclared = False
    for number in block.numbers:
        met = {source for source, values in pools.items() if any(map(number.is_met_by, values))}
        met |= {number.written} & set(entry.constants)
        used |= met
        if not met and not _is_label(figures, name, number):
            undeclared = True
            yield _undeclared(figures, name, block, entry, number)
    if undeclared:  # what it was to be is unused, and no second fault
        return
    for source in [one for one in (*pools, *entry.constants) if one not in used]:
        yield f'{name}.numbers.toml: "{entry.begins}": {source} is declared, but no number of the block is that: remove it'


def _is_label(figures: Figures, name: str, number: Number) -> bool:
    columns = [column for column in figures.columns(name) if number.label and column.header == number.label]
    return any(float(f"{value:.3g}") == number.value for column in columns for cell in column.cells for value in cell)


def _undeclared(figures: Figures, name: str, block: Block, entry: Entry, number: Number) -> str:
    begins = entry.begins or " ".join(block.text.split()[:6])
    near = near_columns(figures, name, number)
    found = f"the same is in {', '.join(near)}" if near else _nearest(figures, name, number)
    return (
        f'{name}.md: "{number.sentence}": {number.written} is none of the figures declared. '
        f'Near: {found}. Correct it, or declare it in {name}.numbers.toml, [[block]] begins = "{begins}" ({HELP})'
    )


def near_columns(figures: Figures, name: str, number: Number) -> list[str]:
    """Return sources that have the number among their figures, those with the fewest figures first."""
    found = []
    for column in figures.columns(name):
        flat = [value for cell in column.cells for value in cell]
        if any(map(number.is_met_by, flat)):
            found.append((len(flat), f"'\"{column.table}:{column.header}\"'"))
    return [words for _, words in sorted(dict.fromkeys(found))[:NEAR_MOST]]


def _nearest(figures: Figures, name: str, number: Number) -> str:
    flat = [
        (abs(abs(value) - abs(number.value)), value, column.header)
        for column in figures.columns(name)
        for cell in column.cells
        for value in cell
    ]
    if not flat:
        return "no figures, as the page has no JSON"
    _, value, header = min(flat)
    return f"{value:.6g} in {header}"
