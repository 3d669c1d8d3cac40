"""The script of the tutorial that draws folders of made-up images, as a module; and small folders of them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

from tree import ROOT

SCRIPT = ROOT / "docs/tutorial/practice_images.py"


def practice_images() -> ModuleType:
    """Return the script as a module; it needs Pillow."""
    spec = importlib.util.spec_from_file_location("practice_images", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def practice_folder(folder: Path, name: str, number: int, seed: int = 1) -> Path:
    """Draw the first `number` images of a set into `folder` and return it."""
    practice_images().draw_folder(name, folder, seed, number)
    return folder
