"""A command as a test calls it: words in, the JSON object that it printed out; and the report page of a file, and its words."""

import html
import json
import re
from pathlib import Path
from typing import Any

import pytest

from pans.app.main import main
from pans.base import SHIPPED


def json_of(capsys: pytest.CaptureFixture[str], command: str, *words: Any, code: int | None = 0) -> dict[str, Any]:
    """Run `pans` with `command`'s words and `words`; it must end with `code` (None: any). Return its JSON object."""
    capsys.readouterr()
    ended = main([*command.split(), *map(str, words), "--json"])
    assert ended == code or code is None
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


class Pans:
    """The fixture `pans`: called with a command's words it is `json_of`."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.said = capsys.readouterr

    def __call__(self, command: Any, *words: Any, code: int | None = 0) -> dict[str, Any]:
        return json_of(self._capsys, str(command), *words, code=code)

    def refuses(self, *words: Any, code: int = 2) -> str:
        """Run `pans` with `words`, which must end with `code`; return what it prints to standard error."""
        assert main([*map(str, words)]) == code
        return self.said().err


def page_of(path: Path, tmp_path: Path) -> str:
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    assert main(["report", str(path), "-o", str(tmp_path / "page.html")]) == 0
    assert [entry.name for entry in tmp_path.iterdir() if "html" in entry.name] == ["page.html"]
    return (tmp_path / "page.html").read_text()


def words_of(page: str) -> str:
    return html.unescape(re.sub(r"<[^>]+>", " ", re.sub(r'src="data:[^"]+"', "", page)))


def fixed_run(objects: int, trials: int = 1) -> tuple[str, ...]:
    """Return the words of a run of the shipped fixed patterns in virtual time, on the first `objects` shipped images."""
    device = "sim:oled-qcmos?scene=fashion200&seed=1&pace=fast"
    many = ("--trials", str(trials), "--decisions", str(objects * trials))
    return ("run", str(SHIPPED / "fashion10.pans"), "--device", device, *many)
