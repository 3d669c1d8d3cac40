"""`pans data scene`: a task's objects as a scene that the simulator opens."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pans.firmware_sim.scene.still import load_scene
from pans.runtime.cli import main
from pans.trainer.tasks.registry import draw_task


@pytest.mark.parametrize("part", ["test", "train"])
def test_a_drawn_task_becomes_a_scene(part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "flow.npz"
    assert main(["data", "scene", "cells", "-o", str(out), "--objects", "6", "--part", part, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["objects"], told["height_px"], told["width_px"], told["part"]) == (6, 100, 100, part)
    scene = load_scene(out)
    task = draw_task("cells", 0, 6, 6)
    wanted = getattr(task, part)
    assert np.array_equal(scene.images, wanted.images)
    assert scene.labels.tolist() == wanted.labels.tolist()
    assert scene.classes == task.classes


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("-o x.npz", "one task"),
        ("cells barcode -o x.npz", "one task"),
        ("cells", "one file"),
        ("cells -o x.png", "ends in .npz"),
        ("cells -o x.npz --objects 0", "--objects is 0"),
        ("cells -o x.npz --data-seed -1", "--data-seed is -1"),
        ("nonsense -o x.npz", "neither one of"),
    ],
)
def test_what_cannot_be_meant_is_refused(words: str, said: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["data", "scene", *words.split()]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
