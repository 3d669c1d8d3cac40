"""The text of a page that is written by hand: its blocks, their sentences, and the numbers in them.

Owns what counts as a number and what does not; knows no figures. A block is a paragraph, one point of a list or one line of a table. Left
out are code, addresses, seeds, what is generated between markers, and the few phrases that name a data set by its size.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

GENERATED = re.compile(r"<!-- (table|counts): begin -->.*?<!-- \1: end -->", re.S)
LEFT_OUT = re.compile(
    r"`[^`]*`|\]\([^)]*\)|<!--.*?-->|SHA-256|\bK = 1\b(?! ?[,/] ?\d| and \d)"  # code, addresses, comments
    r"|\bseeds? \(?\d+\)?(?: and \d+)?(?!\.?\d)|arXiv \d+\.\d+|\bFig\. \d \w(?:, \w)*(?: and \w)?"
    r"|\bFig\. \d\w(?:, \d?\w\b)*|\(Fig\. [^)]*\)"
    r"|\bfirst 200\b|\b200 (?:test )?images\b|\bof the 200\b|\ball 10 000\b|\b10 000 (?:test )?images\b|\b60 000 training\b",
    re.S,
)
# one number: grouped thousands, decimals, powers of ten; no part of a word
NUMBER = re.compile(
    r"(?<![\w.^/])(?P<sign>[+-]?)(?P<figures>\d{1,3}(?: \d{3})+|\d+(?:\.\d+)?(?:e[+-]?\d+)?)(?![\w^]|\.\d)"
)
LABEL = re.compile(r"\b(?P<label>d_f|K|alpha|eta|dark) *(?:=|>=)? *$")
AND = re.compile(r"^(?:, | and | or | to |, and | / )$")  # what may stand between the numbers of one label
_TO_SIXTEEN = "three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen"
WORDS = {word: float(value) for value, word in enumerate(_TO_SIXTEEN.split(), start=3)}
WORD = re.compile(rf"\b(?:{'|'.join(WORDS)})\b", re.I)
POINT = re.compile(r"\n(?=\s*- )|\n(?=\|)")  # where a point of a list or a line of a table begins


@dataclass(frozen=True, slots=True)
class Number:
    """One number of a text: as written (thousands together), its value, its decimals, and its label (d_f, K, ...) or ""."""

    written: str
    value: float
    decimals: int
    signed: bool
    label: str
    sentence: str

    def is_met_by(self, value: float) -> bool:
        """Return whether a figure prints as this number does; of a number without a sign only the size counts.

        >>> one = Number("86.7", 86.7, 1, False, "", "")
        >>> one.is_met_by(86.65), one.is_met_by(-86.74), one.is_met_by(86.8)
        (True, True, False)
        """
        if "e" in self.written:
            return float(f"{value:g}") == self.value
        apart = value - self.value if self.signed else abs(value) - self.value
        return abs(apart) <= 0.5 * 10.0**-self.decimals + 1e-9


@dataclass(frozen=True, slots=True)
class Block:
    """A paragraph, a point or a line of a table, in one line, with its numbers in order."""

    text: str
    numbers: tuple[Number, ...]


def blocks(page: str) -> list[Block]:
    """Return the blocks of a page's text that hold numbers, but for its title and what is generated."""
    text = GENERATED.sub("\n\n", page)
    parts = [part for paragraph in re.split(r"\n\s*\n", text) for part in POINT.split(paragraph)]
    plain = [
        " ".join(part.split()).removeprefix("- ").removeprefix("| ") for part in parts if not part.startswith("# ")
    ]
    found = [Block(one, tuple(numbers(one))) for one in plain]
    return [block for block in found if block.numbers]


def numbers(text: str) -> Iterator[Number]:
    """Yield the numbers of a text in order, those written as words (three to sixteen) too."""
    kept = LEFT_OUT.sub(lambda found: "~" * len(found.group()), text)
    label, end = "", 0
    for found in sorted([*NUMBER.finditer(kept), *WORD.finditer(kept)], key=lambda one: one.start()):
        named = LABEL.search(kept[: found.start()])
        label = named["label"] if named else label if AND.match(kept[end : found.start()]) else ""
        end = found.end()
        yield _number(found, label, _sentence(text, found.start()))


def _number(found: re.Match[str], label: str, sentence: str) -> Number:
    if found.re is WORD:
        word = found.group().lower()
        return Number(word, WORDS[word], 0, False, label, sentence)
    written = found.group().replace(" ", "")
    sign = found["sign"] if label == "" else ""
    decimals = len(written.partition(".")[2]) if "e" not in written else 0
    return Number(written, float(written), decimals, bool(sign), label, sentence)


def _sentence(text: str, place: int) -> str:
    starts = [0, *(found.end() for found in re.finditer(r"[.:;?!] +", text))]
    first = max(start for start in starts if start <= place)
    last = min([start for start in starts if start > place], default=len(text))
    return text[first:last].strip()
