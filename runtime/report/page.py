"""One self-contained HTML page: text, tables and pictures in a single file that needs nothing else.

Owns layout and the inlining of pictures; never measures and never draws (figures.py). Nothing in the page is loaded from
elsewhere and nothing in it runs: no script, no font, no style sheet of another.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pans.runtime import safe_text

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; margin: .6rem 0; } th, td { text-align: left; padding: .15rem .9rem .15rem 0; vertical-align: top; }
th { font-weight: 600; } td { font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.banner { background: #7a1f1f; color: #fff; padding: .5rem .9rem; border-radius: 4px; font-weight: 600; }
.pass { color: #14602a; } .fail { color: #9b1c1c; } .note { color: #555; } figure { margin: .8rem 0; } figcaption { color: #555; }
figure img, figure svg { max-width: 100%; height: auto; } pre { white-space: pre-wrap; background: #f5f5f5; padding: .6rem; }
"""


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
        """Add a paragraph; `kind` is pass, fail, note or nothing."""
        self._parts.append(
            f'<p class="{kind}">{safe_text.html(text)}</p>' if kind else f"<p>{safe_text.html(text)}</p>"
        )

    def table(self, rows: Iterable[Sequence[object]], head: Sequence[str] = ()) -> None:
        """Add a table; the first column names the row."""
        lines = ["<table>"]
        if head:
            lines.append("<tr>" + "".join(f"<th>{safe_text.html(name)}</th>" for name in head) + "</tr>")
        for row in rows:
            cells = "".join(f"<td>{safe_text.html(value)}</td>" for value in row[1:])
            lines.append(f"<tr><th>{safe_text.html(row[0])}</th>{cells}</tr>")
        self._parts.append("\n".join([*lines, "</table>"]))

    def facts(self, facts: Mapping[str, Any]) -> None:
        """Add nested facts as a table of dotted names."""
        self.table(flat(facts))

    def figure(self, picture: bytes, caption: str) -> None:
        """Add a picture, PNG or SVG, with its caption."""
        kind = "png" if picture.startswith(b"\x89PNG") else "svg+xml"
        data = base64.b64encode(picture).decode()
        words, source = safe_text.html(caption), f"data:image/{kind};base64,{data}"
        self._parts.append(f'<figure><img alt="{words}" src="{source}"><figcaption>{words}</figcaption></figure>')

    def html(self) -> bytes:
        """Return the whole page."""
        body = "\n".join(self._parts)
        head = f'<meta charset="utf-8"><title>{safe_text.html(self._title)}</title><style>{_STYLE}</style>'
        return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'.encode()


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
