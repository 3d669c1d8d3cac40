"""Finished parts of long work, kept as JSON files: a killed run goes on, and several pages may share a part.

Owns the file and the check that it was made in the way that is asked for; never makes a part itself.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pans.runtime.container import replace_file


def kept(
    path: Path, made_with: dict[str, Any], make: Callable[[], dict[str, Any]], *, collect: bool
) -> dict[str, Any] | None:
    """Return the part in `path` if it was made with `made_with`, else what `make` returns, after writing it there.

    `made_with` holds what JSON can; `cpu_seconds` (of this process) is added. With `collect` nothing is made: None.
    """
    plain = json.loads(json.dumps(made_with))
    if path.is_file():
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if found.get("made_with") == plain:
            return found
    if collect:
        return None
    started = time.process_time()
    part = make()
    # through JSON: a part just made and one read again are the same to the caller
    text = json.dumps({"made_with": plain, "cpu_seconds": time.process_time() - started, **part})
    replace_file(path, text.encode())
    whole: dict[str, Any] = json.loads(text)
    return whole
