"""The examples in docstrings run, and each public name has its docstring."""

import doctest
import importlib
from pathlib import Path
from typing import Literal, get_origin

import pytest
from tree import FOLDERS, ROOT, name_of

FILES = [path.relative_to(ROOT) for folder in FOLDERS.values() for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize("path", [path for path in FILES if ">>> " in (ROOT / path).read_text()], ids=str)
def test_examples_in_docstrings(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if path.parts[0] == "trainer":
        pytest.importorskip("torch", reason="needs the train extra")
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(importlib.import_module(name_of(ROOT / path)), optionflags=doctest.ELLIPSIS)
    assert found.attempted > 0
    assert found.failed == 0


@pytest.mark.parametrize("path", [path for path in FILES if path.name == "__init__.py"], ids=str)
def test_a_package_exports_what_it_names(path: Path) -> None:
    if path.parts[0] == "trainer":
        pytest.importorskip("torch", reason="needs the train extra")
    package = importlib.import_module(name_of(ROOT / path))
    for name in getattr(package, "__all__", ()):
        value = getattr(package, name)
        assert not callable(value) or get_origin(value) is Literal or value.__doc__, (
            f"{package.__name__}.{name} has no docstring"
        )
