"""What every page of `pans reproduce` is asked for, and how its parts come to be files.

Owns the question (`Asked`) and the writing; never measures and never draws. A page is a dict: `rows` (what becomes NAME.json),
`markdown`, and `pictures`, from the end of a file's name ("" for NAME.png, "-mnist" for NAME-mnist.png) to what draws it at a path.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pans.runtime.cli import say
from pans.runtime.container import replace_file
from pans.runtime.errors import UsageError

NEEDS_PLOT = "pip install 'pans-runtime[plot]'"

Draw = Callable[[Path], None]


@dataclass(frozen=True, slots=True)
class Asked:
    """One page: finished parts lie in `cache`; `rows` are the only numbers of patterns wanted; with `collect` nothing is made."""

    name: str
    cache: Path
    rows: tuple[int, ...] | None = None
    data_dir: str | None = None
    collect: bool = False
    report: Callable[[str], None] = say

    def wants(self, features: int) -> bool:
        """Return whether the row of that many patterns was asked for."""
        return self.rows is None or features in self.rows


def write_page(folder: Path, name: str, page: dict[str, Any]) -> None:
    """Write NAME.json, NAME.md and the page's pictures, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {"json": json.dumps({"rows": page["rows"], "simulated": True}, indent=1) + "\n", "md": page["markdown"]}
    for suffix, text in texts.items():
        replace_file(folder / f"{name}.{suffix}", text.encode())
    pictures: dict[str, Draw] = page.get("pictures", {})
    for ending, draw in pictures.items():
        try:
            draw(folder / f"{name}{ending}.png")
        except ModuleNotFoundError as error:
            raise UsageError("the picture needs matplotlib, which is not installed", remedy=NEEDS_PLOT) from error
