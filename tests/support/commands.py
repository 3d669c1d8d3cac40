"""A command as a test calls it: words in, the JSON object that it printed out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pans.runtime.cli import main


def json_of(capsys: pytest.CaptureFixture[str], command: str, *words: str | Path, code: int = 0) -> dict[str, Any]:
    """Run `pans` with `command`'s words and `words`; it must end with `code`. Return its JSON object."""
    capsys.readouterr()
    assert main([*command.split(), *map(str, words), "--json"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found
