"""One self-contained HTML page: text, tables, drawings and pictures in a single file that needs nothing else.

Every text is escaped here. Nothing in the page is loaded from elsewhere and nothing in it runs: no script, no font, no other style sheet.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pans.runtime import safe_text

WIDE, HALF, NARROW = 880, 430, 345  # pixels of a drawing
CONFUSION_MAX = 40  # classes


@cache
def style() -> str:
    """Return the style sheet of all pages."""
    return files(__package__).joinpath("page.css").read_text(encoding="utf-8")


class Drawing(Protocol):
    """What draws itself for a width, as SVG."""

    def svg(self, width: int) -> str:
        """Return the drawing `width` pixels wide."""


class Picture(NamedTuple):
    """A small picture with its name and lines about it; `lines` may be empty."""

    png: bytes
    name: str
    lines: Sequence[str]


class Page:
    """A page under construction; every text is escaped."""

    def __init__(self, title: str, *, simulated: bool) -> None:
        self._title = title
        self._parts = [f"<h1>{safe_text.html(title)}</h1>"]
        if simulated:
            self._parts.append(
                '<p class="banner">SIMULATED: the clicks come from a simulated instrument, not from light.</p>'
            )

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._parts.append(f"<h2>{safe_text.html(text)}</h2>")

    def text(self, text: str, kind: str = "") -> None:
        """Add a paragraph; `kind` is pass, fail, warn, note or nothing."""
        self._parts.append(
            f'<p class="{kind}">{safe_text.html(text)}</p>' if kind else f"<p>{safe_text.html(text)}</p>"
        )

    def verdict(self, word: str, kind: str, reasons: Sequence[tuple[str, str]]) -> None:
        """Add the verdict with its reasons, each with what to do about it ("" where there is nothing to say)."""
        lines = [f'<div class="verdict {kind}"><strong>{safe_text.html(word)}</strong>']
        for reason, advice in reasons:
            more = f' <span class="note">{_coded(advice)}</span>' if advice else ""
            lines.append(f"<p>{safe_text.html(reason)}{more}</p>")
        self._parts.append("\n".join([*lines, "</div>"]))

    def tiles(self, tiles: Iterable[tuple[str, str, str]]) -> None:
        """Add the main figures large: name, figure, a line about it."""
        items = (
            f"<li><span>{safe_text.html(name)}</span><b>{safe_text.html(figure)}</b><span>{safe_text.html(more)}</span></li>"
            for name, figure, more in tiles
        )
        self._parts.append(f'<ul class="tiles">{"".join(items)}</ul>')

    def table(self, rows: Iterable[Sequence[object]], head: Sequence[str] = (), kind: str = "") -> None:
        """Add a table; the first column names the row. `kind` is facts, long (texts that wrap) or nothing."""
        lines = [f'<table class="{kind}">' if kind else "<table>"]
        if head:
            cells = "".join(f'<th scope="col">{safe_text.html(name)}</th>' for name in head)
            lines.append(f"<thead><tr>{cells}</tr></thead>")
        lines.append("<tbody>")
        for row in rows:
            cells = "".join(f"<td>{safe_text.html(value)}</td>" for value in row[1:])
            lines.append(f'<tr><th scope="row">{safe_text.html(row[0])}</th>{cells}</tr>')
        table = "\n".join([*lines, "</tbody></table>"])
        self._parts.append(table if kind == "long" else _scrolled(table, "table", head))

    def facts(self, facts: Mapping[str, Any]) -> None:
        """Add nested facts as a table of dotted names."""
        self.table(flat(facts), kind="facts")

    def confusion(self, counts: NDArray[np.int64], classes: Sequence[str], caption: str) -> None:
        """Add how often truth (rows) was decided as what (columns), shaded by the share of the row."""
        share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        head = "".join(f'<th scope="col">{safe_text.html(name)}</th>' for name in classes)
        lines = [
            f'<table class="confusion"><thead><tr><th scope="col">truth ↓ decision →</th>{head}</tr></thead><tbody>'
        ]
        for row, name in enumerate(classes):
            cells = "".join(_cell(int(n), float(share[row, at]), row == at) for at, n in enumerate(counts[row]))
            lines.append(f'<tr><th scope="row">{safe_text.html(name)}</th>{cells}</tr>')
        table = _scrolled("".join([*lines, "</tbody></table>"]), "confusion", classes)
        self._parts.append(f"<figure>{table}<figcaption>{safe_text.html(caption)}</figcaption></figure>")

    def figure(self, drawing: Drawing, caption: str, *, half: bool = False) -> None:
        """Add a drawing in its wide and its narrow form; `half` is for one of two `sides`."""
        names: list[tuple[str, str]] = getattr(drawing, "names", [])
        items = "".join(f'<li><i class="{kind}"></i>{safe_text.html(name)}</li>' for kind, name in names)
        legend = f'<ul class="legend">{items}</ul>' if items else ""
        forms = "".join(
            f'<div class="{form}">{drawing.svg(width)}</div>'
            for form, width in (("wide", HALF if half else WIDE), ("narrow", NARROW))
        )
        self._parts.append(f"<figure>{legend}{forms}<figcaption>{safe_text.html(caption)}</figcaption></figure>")

    def pictures(self, pictures: Iterable[Picture], caption: str = "") -> None:
        """Add small pictures side by side, each with its name and lines."""
        items = []
        for one in pictures:
            source = f"data:image/png;base64,{base64.b64encode(one.png).decode()}"
            lines = "".join(f"<span>{safe_text.html(line)}</span>" for line in one.lines)
            image = f'<img class="pixels" alt="{safe_text.html(one.name)}" src="{source}">'
            items.append(f"<li>{image}<b>{safe_text.html(one.name)}</b>{lines}</li>")
        words = f"<figcaption>{safe_text.html(caption)}</figcaption>" if caption else ""
        self._parts.append(f'<figure><ul class="patterns">{"".join(items)}</ul>{words}</figure>')

    def sentences(self, lines: Iterable[str]) -> None:
        """Add a list of sentences."""
        items = "".join(f"<li>{safe_text.html(line)}</li>" for line in lines)
        self._parts.append(f'<ul class="events">{items}</ul>')

    @contextmanager
    def folded(self, title: str) -> Iterator[None]:
        """Fold what is added within away under `title`; a click opens it, without a script."""
        self._parts.append(f"<details><summary>{safe_text.html(title)}</summary>")
        yield
        self._parts.append("</details>")

    @contextmanager
    def sides(self) -> Iterator[None]:
        """Set what is added within side by side where there is room; each part begins with `side`."""
        self._parts.append('<div class="sides"><div>')
        yield
        self._parts.append("</div></div>")

    def side(self) -> None:
        """Begin the next part of `sides`."""
        self._parts.append("</div><div>")

    def html(self) -> bytes:
        """Return the whole page."""
        body = "\n".join(self._parts)
        head = (
            '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
            f'<title>{safe_text.html(self._title)}</title><link rel="icon" href="data:,"><style>{style()}</style>'
        )
        return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n<main>\n{body}\n</main>\n</body></html>\n'.encode()


def _coded(text: str) -> str:
    """Our own text, escaped, with what stands between backticks as code."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", safe_text.html(text))


def _cell(count: int, share: float, right: bool) -> str:
    kind = ' class="right"' if right else ""
    shade = f' style="background: rgba(var(--shade), {0.42 * share:.2f})"' if count else ""
    return f"<td{kind}{shade}>{count or ''}</td>"


def _scrolled(table: str, what: str, head: Sequence[str]) -> str:
    """A table that may be wider than a telephone scrolls by itself; the keyboard reaches it."""
    if len(head) < 3:
        return table
    return f'<div class="scroll" tabindex="0" role="region" aria-label="{what}">{table}</div>'


def flat(facts: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    """Yield (dotted name, text) of nested facts; empty ones are left out."""
    for name, value in facts.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        elif isinstance(value, list | tuple):
            if value:
                yield f"{prefix}{name}", ", ".join(str(item) for item in value)
        elif value is not None and value != "":
            yield f"{prefix}{name}", f"{value:.6g}" if isinstance(value, float) else str(value)
