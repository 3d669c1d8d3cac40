"""Text from outside made inert for where it goes: a terminal, a Markdown page, HTML, a CSV cell, a file name.

Every output of device strings, class names, file names and calibrations goes through one of these. JSON needs none: it is ASCII with
escapes, and stays exact. Characters that do something instead of being seen (controls, line and paragraph separators,
changes of the writing direction, surrogates, private ones) become their Python escapes; what is too long is cut and ends in an ellipsis.

>>> one_line("SN-1\\x1b[2J\\nPASS")
'SN-1\\\\x1b[2J\\\\nPASS'
>>> csv_cell("=HYPERLINK(1)")
"'=HYPERLINK(1)"
"""

from __future__ import annotations

import base64
import html as _html
import re
from collections.abc import Iterable, Mapping
from typing import Any

LINE_MAX = 2000  # characters of one line of foreign text
FILE_NAME_MAX = 100
# no parentheses: they begin nothing without a bracket before them; neither does "_" within a word, nor "&" without ";"
_MARKDOWN = re.compile(r"([\\`*{}\[\]<>#|~!$^]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])|&(?=#?\w+;))")
_FORMULA = tuple("=+-@\t\r＝＋－＠")  # what spreadsheets take for a formula; the wide forms too
_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?([eE][+-]?\d+)?")
_NO_FILE_NAME = re.compile(r"[^A-Za-z0-9._-]+")
_DEVICES = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")  # names that Windows keeps for itself


def one_line(value: Any, most: int = LINE_MAX) -> str:
    """Return `value` as one visible line of at most `most` characters."""
    text = str(value)
    shown = _visible(text[:most])
    return f"{shown[: most - 1]}…" if len(text) > most or len(shown) > most else shown


def lines(value: Any) -> str:
    """Return a text that we made, of several lines, for a terminal: foreign parts of it can move nothing and recolour nothing."""
    return _visible(str(value), kept="\n\t")


def _visible(text: str, kept: str = "") -> str:
    return "".join(letter if letter.isprintable() or letter in kept else ascii(letter)[1:-1] for letter in text)


def markdown(value: Any, most: int = LINE_MAX) -> str:
    """Return `value` as one line that Markdown shows as it is, in a paragraph, a list or a cell of a table."""
    text = _MARKDOWN.sub(r"\\\1", one_line(value, most))
    return (
        re.sub(r"^(\s*)([-+=:.]|\d+[.)])", r"\1\\\2", text)
        if re.match(r"\s*([-+](?=[-+\s]|$)|[=:]|\d+[.)]\s)", text)
        else text
    )


def html(value: Any, most: int = 100 * LINE_MAX) -> str:
    """Return `value` for a text or an attribute of an HTML page; its line ends stay."""
    return _html.escape("\n".join(one_line(line, most) for line in str(value).split("\n")), quote=True)


def csv_cell(value: Any) -> Any:
    """Return a text that no spreadsheet takes for a formula, on one line; anything but text stays as it is."""
    if not isinstance(value, str):
        return value
    shown = one_line(value)
    formula = value.lstrip(" ").startswith(_FORMULA) and not _NUMBER.fullmatch(value)
    return f"'{shown}" if formula else shown


def file_name(value: Any, otherwise: str = "unnamed") -> str:
    """Return a name for a file made from `value`: letters, digits, dot, dash and underscore, no leading dot."""
    name = _NO_FILE_NAME.sub("-", str(value)).strip(".-")[:FILE_NAME_MAX].rstrip(".-")
    return f"{otherwise}-{name}" if _DEVICES.fullmatch(name) else name or otherwise


TEXT_MAX = 300
PICTURE_PX = 56


def html_card(title: str, rows: Mapping[str, Any], pictures: Iterable[tuple[str, bytes]] = ()) -> str:
    """Return HTML with a title, one line for each row whose value is not None or "", and PNG pictures with their names.

    >>> html_card("<b>", {"size": 3, "nothing": None})
    '<table><caption><b>&lt;b&gt;</b></caption><tbody><tr><th>size</th><td>3</td></tr></tbody></table>'
    """
    told = "".join(
        f"<tr><th>{_text(name)}</th><td>{_text(_shown(value))}</td></tr>"
        for name, value in rows.items()
        if value is not None and value != ""
    )
    shown = "".join(_picture(name, data) for name, data in pictures)
    drawn = f"<div>{shown}</div>" if shown else ""
    return f"<table><caption><b>{_text(title)}</b></caption><tbody>{told}</tbody></table>{drawn}"


def _picture(name: str, data: bytes) -> str:
    source = f"data:image/png;base64,{base64.b64encode(data).decode()}"
    style = f"width:{PICTURE_PX}px;margin:2px;image-rendering:pixelated;border:1px solid currentColor"
    return f'<img src="{source}" alt="{_text(name)}" title="{_text(name)}" style="{style}">'


def _text(value: Any) -> str:
    return html(value, TEXT_MAX)


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return ", ".join(str(one) for one in value)
    return str(value)
