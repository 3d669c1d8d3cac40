"""A bundle's data set is found again, wherever bundle and data went together, or the error says where it was looked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from pans.runtime.errors import UsageError
from pans.trainer.tasks.registry import path_from, remembered_task


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "lab/data/parts").mkdir(parents=True)
    (tmp_path / "lab/bundles").mkdir()
    monkeypatch.chdir(tmp_path / "lab")
    return tmp_path / "lab"


def told(bundle: str, task: str) -> dict[str, str]:
    return {"task_argument": Path(task).name, "data_path": path_from(Path(bundle), task), "data_sha256": "ab" * 32}


def test_a_name_needs_no_place() -> None:
    assert path_from(Path("x.pans"), "cells") == ""
    assert remembered_task({"task_argument": "cells"}, "cells", Path("x.pans")) == "cells"


def test_it_is_found_from_anywhere_and_after_a_move(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    provenance = told("bundles/parts.pans", "data/parts")
    assert provenance["data_path"] == "../data/parts"
    assert Path(remembered_task(provenance, "parts", Path("bundles/parts.pans"))).samefile("data/parts")
    moved = lab.rename(lab.with_name("moved"))
    monkeypatch.chdir("/")
    found = remembered_task(provenance, "parts", moved / "bundles/parts.pans")
    assert Path(found).samefile(moved / "data/parts")


def test_beside_the_bundle_and_in_the_working_folder(lab: Path) -> None:
    older = {"task_argument": "parts.npz"}  # of a bundle without a path
    for place in ("bundles/parts.npz", "parts.npz"):
        Path(place).touch()
        assert Path(remembered_task(older, "parts", Path("bundles/parts.pans"))).samefile(place)
        Path(place).unlink()


def test_what_is_not_there_is_told_with_the_places(lab: Path) -> None:
    with pytest.raises(UsageError) as caught:
        remembered_task(told("bundles/parts.pans", "gone/parts"), "parts", Path("bundles/parts.pans"))
    assert "looked for gone/parts, parts, bundles/parts" in caught.value.message
    assert "SHA-256 abababababab…" in caught.value.message
    assert caught.value.remedy.startswith("name it: --task")
