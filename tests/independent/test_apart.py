"""What makes the independent programs worth something: they share no code with the package."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import lab_frames
import pytest
from tree import ROOT

HERE = Path(__file__).parent
PROGRAMS = sorted(HERE.rglob("lab_*.py"))


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_nothing_of_the_package_is_imported(path: Path) -> None:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).split(".")[0])
    allowed = {"numpy", *sys.stdlib_module_names, *(program.stem for program in PROGRAMS)}
    assert names <= allowed, names - allowed


def test_the_worked_example_of_the_page() -> None:
    page = (ROOT / "docs" / "reference" / "protocol.md").read_text()
    assert f"**0x{lab_frames.SCHEMA:08X}**" in page
    assert f"`{lab_frames.SCHEMA_TEXT}`" in page
    hello = lab_frames.frame(lab_frames.HELLO, lab_frames.SCHEMA.to_bytes(4, "little") + b"\1\0\0\0", 0x11223344)
    assert hello.hex(" ").upper() in page
