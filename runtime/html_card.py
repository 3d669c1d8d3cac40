"""A small table with pictures for a notebook: what `_repr_html_` of bundles, profiles, recordings and runs returns.

Every text is escaped; there is no script and no style sheet.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from typing import Any

from .safe_text import html

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
