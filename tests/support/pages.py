"""A report page of a file, and its words without the markup."""

from __future__ import annotations

import html
import re
from pathlib import Path

from pans.runtime.cli import main


def page_of(path: Path, tmp_path: Path) -> str:
    assert main(["report", str(path), "-o", str(tmp_path / "page.html")]) == 0
    assert [entry.name for entry in tmp_path.iterdir() if "html" in entry.name] == ["page.html"]
    return (tmp_path / "page.html").read_text()


def words_of(page: str) -> str:
    return html.unescape(re.sub(r"<[^>]+>", " ", re.sub(r'src="data:[^"]+"', "", page)))
