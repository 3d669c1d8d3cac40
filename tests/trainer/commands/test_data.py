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


def test_what_cannot_be_meant_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "x.npz")
    for words, said in [
        (["scene", "-o", out], "one task"),
        (["scene", "cells", "barcode", "-o", out], "one task"),
        (["scene", "cells"], "one file"),
        (["scene", "cells", "-o", str(tmp_path / "x.png")], "ends in .npz"),
        (["scene", "cells", "-o", out, "--objects", "0"], "--objects is 0"),
        (["scene", "nonsense", "-o", out], "neither one of"),
    ]:
        assert main(["data", *words]) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
