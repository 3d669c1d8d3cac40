"""The notebooks of the tutorial: each runs in a kernel of its own, shows what is kept in the file, and is a page of the site."""

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import pytest
from tree import ROOT

pytest.importorskip("nbclient")
SPEC = importlib.util.spec_from_file_location("notebooks", ROOT / "docs/assets/notebooks.py")
assert SPEC is not None
assert SPEC.loader is not None
HOOK = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(HOOK)
PICTURE_MAX = 60_000  # bytes of one picture, as Base64


def outputs(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [output for cell in notebook["cells"] for output in cell.get("outputs", ())]


def pictures(notebook: dict[str, Any]) -> list[str]:
    found = [output.get("data", {}).get("image/png") for output in outputs(notebook)]
    return ["".join(one) for one in found if one]


def printed(notebook: dict[str, Any]) -> list[str]:
    return ["".join(output["text"]) for output in outputs(notebook) if output["output_type"] == "stream"]


def test_there_are_three() -> None:
    assert [path.stem for path in HOOK.notebooks()] == ["late-decision", "train-and-judge", "watch-an-instrument"]


@pytest.mark.parametrize("name", ["late-decision", "watch-an-instrument", "train-and-judge"])
def test_a_notebook_runs_and_shows_what_is_kept(name: str, tmp_path: Path) -> None:
    path = ROOT / f"docs/tutorial/{name}.ipynb"
    kept = json.loads(path.read_text(encoding="utf-8"))
    found = HOOK.executed(path, tmp_path)
    assert len(pictures(found)) == len(pictures(kept)) >= 2
    assert max(map(len, pictures(kept))) < PICTURE_MAX
    if name != "train-and-judge":  # training rounds otherwise on other processors
        assert printed(found) == printed(kept)
    # no paths of a machine: nothing that begins with a slash, of two parts or more
    assert not re.search(r"PosixPath|[\s>'\"=(]/\w[\w.-]*/", json.dumps([outputs(found), outputs(kept)]))
    assert any("SIMULATED" in "".join(cell["source"]) for cell in kept["cells"])
    page = HOOK.page_of(path)
    assert page.count("data:image/png") >= len(pictures(kept))
    assert ".ipynb)" not in page.replace(f"({path.name})", "")
